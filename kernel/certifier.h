// SPDX-License-Identifier: Apache-2.0

/* What the files of the certificate share: residue.c, what words leave over; words.c, what is doubtful of single words;
 * rivals.c, frames that explain as much; certificate.c, the clauses. */
#ifndef TACTILE_CERTIFIER_H
#define TACTILE_CERTIFIER_H

#include "certificate.h"

struct certifier {
    const struct code *code;
    struct certificate_limits limits;
    float *expected;
    const uint8_t *broken;
    float *rows;   /* (k, N) of the frame */
    float *model;  /* (k, N) chips of its words */
    float *padded; /* (k, N) what they leave over, and CERTIFICATE_SIDE chips on either side */
    float *work, *other, *without; /* (k, N) */
    float *ones;   /* (k, N) rows of an offset of 1 V, where codes are scrambled; else NULL: it is all on row 0 */
    float *offset; /* (k) V, of each bit: what its chips have in common */
    bool leaks;    /* what leaks from chip to chip is taken off what is left of them */
    float *power, *most; /* (N) of what is left on a row: sum of squares, greatest square */
    float *mean;   /* (N) */
    /* V, what is left of chips beside the frame, before it and then after it; with what leaks there; NaN: not seen */
    float beside[CERTIFICATE_BESIDE], leaked[CERTIFICATE_BESIDE];
    double edges;          /* V, by which edges may put a chip off */
    double beyond, worse;  /* V²: sum of squares of what is left beyond that; by which that of a rival must be more */
    struct words_measures measures;
};

/* What is known of a frame while its clauses are computed; powers in V². */
struct reading {
    const struct certificate_view *view;
    double swing, weakest, least; /* V: of a node; of the words; the less of both */
    double free;                  /* degrees of freedom that the words leave to noise */
    double total, left;           /* sum of squares of what is left, and over `free` */
    double more;                  /* that edges of the words may leave */
    size_t speakers, side;        /* side: chips before the frame, and after it, of what is left beside it */
    double shown;                 /* sum of squares of what is left with leakage, there and in the frame */
};

static inline float *left_of(const struct certifier *certifier)
{
    return certifier->padded + CERTIFICATE_SIDE;
}

/* Chips (k, N) → what every row holds, (k, N) V. May be done in place. */
void certifier_rows(const struct code *code, const float *chips, float *rows);

/* What every row holds → chips: the inverse. */
void certifier_chips(const struct code *code, const float *rows, float *chips);

/* What the words leave over, without the offset of each bit. */
void certifier_leave(const struct certifier *certifier, const float *chips, float *left);

/* Takes off a share of other values. */
void certifier_take_off(const float *from, float share, size_t size, float *left);

/* The greatest |x|. */
double certifier_greatest(const float *values, size_t size);

/* Mean |x| of each of `size` columns of k rows, `step` apart. */
void certifier_means(const float *rows, size_t step, size_t bits, size_t size, float *mean);

/* Sum of squares that words of one amplitude leave of rows (k, N), and whether they are others than a frame's. */
double certifier_rows_left(struct certifier *certifier, const float *rows, const struct words *words, bool *differ);

/* Sum of squares of chips beside the frame, where seen. */
double certifier_sum_beside(const float *beside, size_t count);

/* Chips beside a frame without their offset and what leaks from it, which is taken off its chips, too. Sum of squares,
 * V², of what was left in the frame before that. */
double certifier_beside(struct certifier *certifier, const struct certificate_view *view);

/* Sum of squares, V², by which what is left, in the frame and beside it, is more than edges do. */
double certifier_beyond_edges(const struct certifier *certifier, size_t side);

/* What the frame's words leave over, in chips and on rows. */
struct reading certifier_residue(struct certifier *certifier, const struct certificate_view *view,
                                 const struct words *words);

/* Who spoke, and how many; weakest: V, of those. */
size_t certifier_speakers(struct certifier *certifier, double noise_v2, const struct words *words, double *weakest);

/* Marks doubtful words that may be parts of others, and faint silent nodes: whether there are any. value: of WORDS. */
bool certifier_doubt(const struct certifier *certifier, const struct reading *reading, const struct words *words,
                     double *value);

/* Marks silences and words that the certificate makes doubtful, and says whether the frame is understood. */
void certifier_conclude(struct certifier *certifier, const struct reading *reading, const struct words *words,
                        bool any_faint, struct certificate *certificate);

/* Whether a delay makes one of these words that of another node, whose row is `alike`, as likely. rows: of what is
 * left, read later by the twin's shift. Its value, of which 1 is the limit. */
double certifier_twin(const struct certifier *certifier, const struct reading *reading, const struct code_twin *twin,
                      const float *rows, float amplitude);

/* Rivals: the frame some chips beside its place, or from one of its bits on, where a chip was taken twice or not at
 * all. Shifts that leave out louder chips than a rival may are none. sign: later, or earlier. */
double certifier_shifted_frames(struct certifier *certifier, const struct reading *reading, const struct words *words,
                                int sign);

/* Sum of squares by which a rival must leave more, V², so that a word of this amplitude, V, is certain. */
double certifier_least_worse(const struct certifier *certifier, const struct reading *reading, double amplitude);

#endif
