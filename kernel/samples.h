// SPDX-License-Identifier: Apache-2.0

/* Samples of the line → chips: the sums of tactile_cdma/base/sums.py and fit.py over all samples. */
#ifndef TACTILE_SAMPLES_H
#define TACTILE_SAMPLES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Counts of a converter as volts: (count − zero)·per_count. */
void samples_volts(const int16_t *counts, size_t size, float zero, float per_count, float *volts);

/* Copies samples; those that are not within ±most, V, become NaN. */
void samples_copy(const float *volts, size_t size, double most, double *copy);

/* What samples add up to: their sum and the sum of their squares. */
struct samples_sums {
    double sum, squares;
};

struct samples_sums samples_add(const double *volts, size_t size);

/* How many samples are not between two levels: at either, or beyond. */
size_t samples_outside(const double *volts, size_t size, double low, double high);

/* Edges of chips in samples: how many whole samples come before each of `count` edges, the share of the
 * next one, and the number of samples between edges; see ChipEdges in fit.py. */
struct samples_edges {
    size_t count;
    const int32_t *whole; /* rising, below the number of samples */
    const double *share, *number;
};

/* Mean level between edges, but for `level`, of `size` chips, which begin at these edges (rising). False
 * where the edges are not within `samples` samples, or the places not within the edges. */
bool samples_chips(const double *volts, size_t samples, double level,
                   const struct samples_edges *edges, const int32_t *places, size_t size, float *chips);

#endif
