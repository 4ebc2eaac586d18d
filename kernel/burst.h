// SPDX-License-Identifier: Apache-2.0

/* The loud part of a stretch of samples, and the gaps beside it: what framing/gaps/burst.py does with an array of
 * half chips. In C because every sample of the stream passes here, most of them in silence, and because
 * numpy takes some fifty calls for it. */
#ifndef TACTILE_BURST_H
#define TACTILE_BURST_H

#include <stdbool.h>
#include <stddef.h>

/* Lengths and limits of a search; see BurstSearch, and burst.py for the factors. half: samples of half a
 * chip. window: half chips in which the gap is measured. group: half chips of a cell. low, high: cells of the
 * shortest and the longest frame. bit: cells of a bit, and one. width: half chips that hold a whole bit
 * wherever they begin. gap_size: samples of a gap; side: half chips of it that must be quiet. */
struct burst_search {
    size_t half, window, group, low, high, bit, width, gap_size, side, nodes;
    double chip, snr_floor, loud, no_power, bias, newest, calmer, drifting, median, beside_level,
        beside;
};

/* As Gap. */
struct burst_gap {
    double level, variance;
    size_t begin;
};

/* As Burst. */
struct burst_found {
    double first, last, slack, power, variance, pause;
};

/* As Beside. */
struct burst_beside {
    double level, variance;
    bool quiet;
    double noise;
};

/* Means of half chips: size / half. */
void burst_halves(const struct burst_search *search, const double *volts, size_t size, double *means);

/* Values of scratch that so many half chips take. */
size_t burst_scratch(size_t count);

/* The quietest window of half chips about the known level. False where they are too few for one, or one is NaN. */
bool burst_gap(const struct burst_search *search, const double *means, size_t count,
               const struct burst_gap *known, struct burst_gap *gap, double *scratch);

/* Whether there is a burst, beside this gap. least_power: of a node, V². */
bool burst_find(const struct burst_search *search, const double *means, size_t count, double least_power,
                const struct burst_gap *gap, struct burst_found *found, double *scratch);

/* The gaps before sample `first` and from sample `end` on, of a level. variance, power: of the burst
 * between. */
struct burst_beside burst_beside(const struct burst_search *search, const double *volts, size_t size,
                                 double level, size_t first, size_t end, double variance, double power,
                                 float *scratch);

#endif
