// SPDX-License-Identifier: Apache-2.0

/* Levels of nodes → words: amplitude, code, and how sure each word is by itself. Flags are bytes, 0 or 1. */
#ifndef TACTILE_WORDS_H
#define TACTILE_WORDS_H

#include "code.h"

#define WORDS_MOST_BITS 31

/* What k levels r say of each of n nodes, (n): mean, least and greatest |r|; sum of r²; the signs as bits, the
 * first one highest; and the first bit with the least |r|. */
struct words_measures {
    float *amplitude, *weakest, *strongest, *squares;
    int32_t *signs, *weakest_bit;
};

/* Limits in words/limits.py, which says what each is. Shares are of the amplitude that is expected of a node, but
 * low_margin, clear_margin and lower, which are of the word's own: clear_margin also by which its strongest bit may
 * be above that. A doubtful word whose weakest bit is below low_margin of what is expected may be that of two. */
struct words_limits {
    float low_rho, low_margin, clear_margin, even_rho, two, shared, clear_rho, lower;
};

/* What is said of every node, (n). active: it spoke. codes: its word. amplitude, V. rho, margin: see
 * words/words.py. doubtful: its word, or its silence, is uncertain. doubled: more than one node speaks on its row.
 * odd: its parity was mended. faint: it did not speak, but its row holds more than noise. */
struct words {
    uint8_t *active, *doubtful, *doubled, *odd, *faint;
    int32_t *codes;
    float *amplitude, *rho, *margin;
};

/* Words in memory of so many bytes a node, which begins where floats may: amplitude, rho, margin, codes, then the
 * flags in their order above. */
#define WORDS_BYTES 21
struct words words_in(uint8_t *memory, size_t nodes);

/* Measures levels: k rows of n values, `step` values from row to row. */
void words_measure(const float *levels, size_t step, size_t bits, size_t nodes, const struct words_measures *measures);

/* Amplitude of a sound node, V: the second of three loud ones, as the loudest may be that of several on one row.
 * loudest: through this, of all. A word counts as loud from loud_share of the loudest on. */
float words_usual(const float *amplitude, size_t nodes, float loud_share, float *loudest);

/* Codes, and what speaks against each word; takes amplitude and active as they are. expected: (n) V. per_noise: 1/V. */
void words_decide(const struct words_measures *measures, const struct code *code, const float *expected,
                  float per_noise, const struct words_limits *limits, const struct words *words);

#endif
