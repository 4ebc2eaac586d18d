// SPDX-License-Identifier: Apache-2.0

/* Multiuser detection of sparse codes: detect in tactile_cdma/code/detect.py, where it is explained, in the same steps.
 * Rows are kept by code number meanwhile, in the order of the transform, and words only of those who have some, so that
 * what a turn costs beside its two transforms grows with those who speak. */
#ifndef TACTILE_SPARSE_H
#define TACTILE_SPARSE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "transform.h"

/* As the constants of detect.py. swing: amplitude of a node, V; least: of a word that is taken off. negligible: V². */
struct sparse_rules {
    double swing, least, soft_noise, slope, log_odds, hard_share, settled, negligible, stalled;
    size_t turns;
};

/* A book. rows: 2^m. walsh: their transform, unscaled. places: (k, N) of chips in their bit's 2^m. flips: (k, N).
 * codes: (2^m,) code number of every row; those of nodes are 1 … nodes. */
struct sparse_book {
    size_t bits, order, rows, nodes;
    const struct transform *walsh;
    const int32_t *places, *codes;
    const float *flips;
};

/* As Detected: rows (k, 2^m), heard (n), left (k, N), power (k). */
struct sparse_found {
    float *rows, *left;
    bool *heard;
    double *power, level;
    bool settled;
};

struct sparse;

struct sparse *sparse_new(const struct sparse_book *book, const struct sparse_rules *rules); /* NULL: no memory */
void sparse_free(struct sparse *sparse);
void sparse_detect(struct sparse *sparse, const float *chips, double damping, struct sparse_found *found);

/* Mean |r| of every node, (n,) V, in chips (k, N) that are read so many later in their bits. */
void sparse_loudness(struct sparse *sparse, const float *chips, ptrdiff_t lateness, float *loudness);

#endif
