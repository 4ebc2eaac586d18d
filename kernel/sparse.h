// SPDX-License-Identifier: Apache-2.0

/* Multiuser detection of sparse codes: detect in tactile_cdma/code/detect.py, where it is explained, in the same steps;
 * and the certificate of framing/sparse_timing.py. Levels are kept by code number, in the order of the transform, and words
 * only of those who have some, so that what a turn costs beside its two transforms grows with those who speak. */
#ifndef TACTILE_SPARSE_H
#define TACTILE_SPARSE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "transform.h"

/* As the constants of detect.py. swing: amplitude of a node, V; least: of a word that is taken off. negligible: V².
 * From capacity on, of the certificate in sparse_timing.py. chance, chance_of_bit: shares by which the noise of a frame
 * and of a bit may be off; most_noise: mean square of what is left, V²; silent_square, V², silent_power: see rises in amplitude.py. */
struct sparse_rules {
    double swing, least, soft_noise, slope, log_odds, hard_share, settled, near, negligible, stalled;
    size_t turns, capacity;
    double most_noise, more, tolerance, chance, chance_of_bit, hiding, weight, silent_square, silent_power;
    bool alike; /* codes of those who speak may add up to nothing */
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

/* What a certain frame says beside its words. noise: V RMS, of a level. */
struct sparse_told {
    double level, noise;
    size_t speakers;
};

struct sparse;

struct sparse *sparse_new(const struct sparse_book *book, const struct sparse_rules *rules); /* NULL: no memory */
void sparse_free(struct sparse *sparse);
const struct sparse_book *sparse_book(const struct sparse *sparse);
void sparse_detect(struct sparse *sparse, const float *chips, double damping, struct sparse_found *found);

/* Reads a frame that leaves nothing to decide, as SparseRecogniser does; false for any other. noise: V², of a chip, in
 * the frames before, and then with this one. spoke: (n) nodes, from 0 on, in any order. levels: (k, speakers), V. */
bool sparse_read(struct sparse *sparse, const float *chips, double *noise, float *levels, int32_t *spoke,
                 struct sparse_told *told);

/* Learns the noise from that of one frame, V²; 0: unknown. */
void sparse_learn(const struct sparse *sparse, double found, double *noise);

/* Mean |r| of every node, (n,) V, in chips (k, N) that are read so many later in their bits. */
void sparse_loudness(struct sparse *sparse, const float *chips, ptrdiff_t lateness, float *loudness);

#endif
