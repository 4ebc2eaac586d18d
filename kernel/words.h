// SPDX-License-Identifier: Apache-2.0

/* Levels of nodes → words: the stages of tactile_cdma/words/decode.py and framing/fit.py that pass over
 * all levels or all nodes. Arithmetic is that of numpy in float32, per node in the same order. Flags are
 * bytes, 0 or 1. */
#ifndef TACTILE_WORDS_H
#define TACTILE_WORDS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* What k levels r say of each of n nodes, (n,): mean, least and greatest |r|; sum of r²; the signs as
 * bits, the first one highest; and the first bit with the least |r|. */
struct words_measures {
    float *amplitude, *weakest, *strongest, *squares;
    int32_t *signs, *weakest_bit;
};

/* Of words/limits.py and code/amplitude.py. */
struct words_limits {
    float low_rho, low_margin, shared, two, clear_rho, lower;
};

struct words_decided {
    int32_t *codes;
    float *rho, *margin;
    uint8_t *doubtful, *doubled, *odd;
};

/* How the words of a frame are read from the correlations of all rows; see read_words in fit.py. */
struct words_frame {
    size_t bits, order, first, nodes; /* order: rows; first: of the nodes' rows */
    bool unipolar;
    float swing; /* amplitude of a node, V; NaN: unknown */
    float loudest_share, active_share;
    double spoken_over; /* see separate.py */
};

/* Of one candidate. rows: (k, N). amplitude, uneven: (n,). Returns through the others as WordFit; without a misfit,
 * neither power nor spread. */
void words_fit(const struct words_frame *frame, const float *rows, float *amplitude, float *uneven,
               float *pedestal, float *power, float *spread, float *misfit);

/* The same of `count` candidates, whose values follow each other. */
void words_fit_all(const struct words_frame *frame, size_t count, const float *rows, float *amplitude, float *uneven,
                   float *pedestal, float *power, float *spread, float *misfit);

/* What the bit of which words leave the most leaves more than the others, V²: see WordFit.is_clear. amplitude: (n,) V,
 * of the words. */
double words_most_left(const struct words_frame *frame, const float *rows, const float *amplitude);

/* Noise of one correlation, V RMS: of `count` spare rows from `spare` on, or of the words where fewer
 * than two rows are spare; see node_levels in separate.py. */
double words_noise(const struct words_frame *frame, const float *rows, size_t spare, size_t count);

/* What words are read by, besides: see decode.py. a_chip, few, few_share: lateness.py. */
struct words_reading {
    float threshold, faint_share, sound_share, most_square, a_chip, few_share, tone_share, moved_share;
    /* A silent row's squares over expected² and noise², and expected over noise: see _find_active. */
    float least_squares, loud_squares, hiding_rho;
    size_t few;
    bool parity;
    struct words_limits limits;
};

enum words_look {
    WORDS_NEED_STAGES, /* a word is faint or uneven, or none is spoken; nothing is meant by the arrays */
    WORDS_LEAVE_ENERGY, /* as much as a chip of one of them: some may be out of place */
    WORDS_LEAVE_MUCH,   /* as much as a tone on one of their rows leaves */
    WORDS_ARE_PLAIN,
};

/* The words of a frame, as decode in decode.py reads them. per_noise: 1/V. rows: (k, N).
 * offset: (k, N), rows of an offset of 1 V in scrambled chips; NULL where they are not. expected: (n,) V,
 * written to unless least_usual (V, of the usual amplitude) is NaN. */
enum words_look words_read(const struct words_frame *frame, const struct words_reading *reading,
                           float per_noise, float least_usual, const float *rows,
                           const int32_t *sign_mask, const float *offset, float *expected,
                           const struct words_measures *measures,
                           const struct words_decided *decided, uint8_t *active);

/* The same of a frame in which only some nodes have levels, (k, speakers), and detection has looked at the rest: of
 * sparse codes. measures: of these only; amplitude and others: (n,), of all. */
enum words_look words_read_some(const struct words_frame *frame, const struct words_reading *reading, float per_noise,
                                float least_usual, const float *levels, const int32_t *spoke, size_t speakers,
                                const int32_t *sign_mask, float *expected, const struct words_measures *measures,
                                float *amplitude, const struct words_decided *decided, uint8_t *active);

#define WORDS_MOST_BITS 31

/* Limits of late in lateness.py. */
struct words_lateness {
    float late_share, by_chance, of_two;
};

/* As late in lateness.py, but for what leaks, of frames of 2 to WORDS_MOST_BITS bits. meant: (N,) amplitude of the words
 * on all rows, 0 where none was spoken. edges: (4, N) last but one, last, first and second chip of all
 * rows. late: (n,). */
void words_late(const struct words_frame *frame, const float *rows, const float *meant,
                const float *edges, const struct words_lateness *limits, uint8_t *late);

#endif
