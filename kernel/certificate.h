// SPDX-License-Identifier: Apache-2.0

/* Chips of a frame → its words, and a certificate: whether what the words leave over is no more than noise, in every
 * direction in which we know what an error looks like. docs/architecture.md tells the idea, words/limits.py where
 * each limit comes from.
 *
 * A frame is words + an offset of each bit + what leaks from the chips beside + noise. Five clauses look at what is
 * left, the residue. Each gives a value of which 1 is the limit; from there on all words and all silences of the
 * frame are doubtful. Besides, a word may be doubtful by itself, and so may the silence of a node on whose row there
 * is more than noise.
 *
 * Cost: two transforms of the frame, one more where chips leak into others, four more where what is left could hold a
 * node that is out of its place, and eight more where the codes are not scrambled and few nodes speak. */
#ifndef TACTILE_CERTIFICATE_H
#define TACTILE_CERTIFICATE_H

#include "code.h"
#include "words.h"

enum certificate_clause {
    CLAUSE_ENERGY, /* what is left of the frame, of each bit, of each chip; and within chips (frame_reader.c) */
    CLAUSE_ATOMS,  /* what is left on each row in place, and on those of nodes that are out of theirs */
    CLAUSE_RIVALS, /* how well the frame, its later bits, or one node explain it elsewhere */
    CLAUSE_REST,   /* what the line does beside the frame, and how its offset moves within */
    CLAUSE_WORDS,  /* whether a word is weak while a silent row holds more than noise */
    CERTIFICATE_CLAUSES
};

/* Limits in words/limits.py, which says what each is. A is the amplitude of a node, and shares are of it unless it is
 * said. */
struct certificate_limits {
    struct words_limits words;
    double deviations, log_odds, left, left_of_word, bit, chip, leak, atom, row;
    double faint, faint_bit, faint_deviations, better, edges, beside, moves, silent_rho, hidden;
    double weak, loud_share, unknown_noise, uneven;
    size_t few;
};

/* Mean square, A², that edges of so many words may leave beside noise. */
static inline double certificate_more(const struct certificate_limits *limits, double words)
{
    return limits->left + limits->left_of_word * limits->left_of_word * words;
}

#define CERTIFICATE_BESIDE 32 /* chips beside a frame that are looked at, at most */
#define CERTIFICATE_SIDE 2 /* chips by which nodes may be off, and on either side of a frame that are asked to be at rest */

/* Chips as they were received. beside: `side` chips before the frame and as many after it, V, NaN where not seen; two
 * at least. noise_v2: of a chip at rest; 0: unknown. clipped: share of the samples. is_noise: it is known to hold no
 * node; only sparse codes ask. rest_unknown: the line's level at rest is, so that a word on row 0 may be it. */
struct certificate_view {
    const float *chips;
    size_t side;
    float beside[CERTIFICATE_BESIDE];
    double noise_v2, clipped;
    bool is_noise, rest_unknown;
    bool rows_known;  /* certifier_left was the last to read these chips */
    bool is_compared; /* certifier_compare is to follow */
    bool is_placed;   /* it is sure to begin here, but for less than a chip */
};

/* left: V², mean square of what the words leave over. row_noise_v: RMS of that on a row, V. swing: A, V. value: of every
 * clause. usual, kurtosis: of what sparse codes leave over, V² of a chip that may be noise, and the shape of all.
 * crowded: the sparse codes of those who spoke are not told apart. understood: the frame says something of its nodes:
 * - if some spoke, the line is at rest beside it, and no more is left than noise, but for the uneven words of few;
 * - if none did, words that are all too weak explain it. */
struct certificate {
    double left, row_noise_v, swing, value[CERTIFICATE_CLAUSES], usual, kurtosis;
    size_t speakers;
    bool understood, crowded;
};

/* The value of the clause that is nearest to its limit, or farthest beyond. */
double certificate_worst(const struct certificate *certificate);

/* What words leave over, chips (k, N), with so many degrees of freedom. noise_v2: known of a chip. more: V², that
 * edges of the words may leave on top of it. better: V², by which less would be left, were the amplitudes of the
 * words final. */
struct certificate_residue {
    const float *left;
    size_t bits, order, speakers;
    double free, noise_v2, more, better, swing;
};

/* The value of ENERGY: of the frame, of each bit, and of each chip; and through `power` the mean square of what is
 * left. */
double certificate_energy(const struct certificate_limits *limits, const struct certificate_residue *residue,
                          double *power);

/* Factor by which a mean of so many squares may exceed that of noise. */
double certificate_chance(double count, double deviations);

struct certifier;

/* The code, what it points to, expected and broken are kept. expected: (n) V, amplitude of every node; written to
 * where the code says that it is unknown. broken: (n) nodes that are known to be faulty or doubled: whatever is on
 * their rows is taken for theirs. NULL: no memory. */
struct certifier *certifier_new(const struct code *code, const struct certificate_limits *limits, float *expected,
                                const uint8_t *broken);
void certifier_free(struct certifier *certifier);

/* Reads a frame. */
void certifier_read(struct certifier *certifier, const struct certificate_view *view, const struct words *words,
                    struct certificate *certificate);

/* Raises CLAUSE_ATOMS of the frame read last by the atoms within its chips. split: (k, N) V, half of what the first
 * half of a chip is above the second one. */
void certifier_split(struct certifier *certifier, const float *split, struct certificate *certificate);

/* Sum of squares, V², that words of one amplitude and leakage explain of chips (k, N), without their levels. */
double certifier_explained(struct certifier *certifier, const float *chips);

/* How near a frame that is read `shift` chips later, in its own timing, comes to being other words that explain as
 * much as those of the frame read last, all of them or all but one; CLAUSE_RIVALS is raised to that. */
void certifier_compare(struct certifier *certifier, const struct certificate_view *view, int shift,
                       const struct words *words, struct certificate *certificate);

/* Mean square, V², that words of one amplitude leave of chips (k, N), and through `power` that of the chips, without
 * the offset that unipolar nodes add by any timing: by these timings are compared. */
double certifier_left(struct certifier *certifier, const float *chips, double *power);

/* Sum of squares, V², of all nodes' mean amplitudes in so many bits of chips, however faint they are. */
double certifier_gain(struct certifier *certifier, const float *chips, size_t bits);

/* The chips (k, N) of such words, with the offset that unipolar nodes add. */
void certifier_model(struct certifier *certifier, const float *chips, float *model);

#endif
