// SPDX-License-Identifier: Apache-2.0

/* Frames of sparse codes that leave nothing to decide, read and certified as SparseRecogniser does in
 * framing/sparse_timing.py, where the rules are explained. In C because the stream reads such frames without Python. */
#ifndef TACTILE_SPARSE_H
#define TACTILE_SPARSE_H

#include "detect.h"

/* Of the certificate, from capacity on, as in sparse_timing.py. chance, chance_of_bit: shares by which the noise of a
 * frame and of a bit may be off; most_noise, hiding: mean squares of what is left, V²; faintest: V;
 * silent_square, V², silent_power: see rises in amplitude.py. */
struct sparse_rules {
    struct detect_rules detect;
    size_t capacity;
    double most_noise, more, tolerance, faintest, chance, chance_of_bit, hiding, weight;
    double silent_square, silent_power;
    bool alike; /* codes of those who speak may add up to nothing */
};

/* What a certain frame says beside its words. noise: V RMS, of a level. */
struct sparse_told {
    double level, noise;
    size_t speakers;
};

struct sparse;

struct sparse *sparse_new(const struct sparse_book *book, const struct sparse_rules *rules);
/* NULL: no memory, or the book is none of this transform, or of so many nodes */
void sparse_free(struct sparse *sparse);
struct detector *sparse_detector(const struct sparse *sparse);
const struct sparse_book *sparse_book(const struct sparse *sparse);

/* Reads a frame; false where anything is to be decided. noise: V², of a chip, in the frames before, and then with this
 * one. spoke: (n) nodes, from 0 on, in any order. levels: (k, speakers), V. */
bool sparse_read(struct sparse *sparse, const float *chips, double *noise, float *levels, int32_t *spoke,
                 struct sparse_told *told);

/* The noise, V², after a frame of so much, as SparseRecogniser.learn does; 0: unknown. */
double sparse_learn(struct sparse *sparse, double noise, double found);

#endif
