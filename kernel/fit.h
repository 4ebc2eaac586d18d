// SPDX-License-Identifier: Apache-2.0

/* A frame of a start and a chip duration in samples: its chips, and where its edges are.
 *
 * Times are in samples; sample i is the line's level at instant i. */
#ifndef TACTILE_FIT_H
#define TACTILE_FIT_H

#include <stddef.h>
#include <stdint.h>

#include "certificate.h"

/* Samples of a line, V, its level of rest, and sums of the samples without that: sums[i] is that of the first
 * i. At most 2³¹ − 1 samples. */
struct fit_line {
    size_t size;
    const float *volts;
    const double *sums;
    double level;
};

struct fit {
    double start, chip;
};

/* How a fit is refined. blur: samples around an edge of which it is uncertain on which side of it they were taken.
 * settled_chips: change below which it ends. reaches: of a chip on either side of an edge, in each turn. */
struct fit_refining {
    double blur, settled_chips;
    size_t turns;
    const double *reaches;
};

/* Instant at which the last of so many chips ends. */
static inline double fit_end(const struct fit *fit, size_t span)
{
    return fit->start + fit->chip * (double)span;
}

/* Running sums of `size` values without a level: size + 1, from 0 on. */
void fit_sums(const float *values, size_t size, double level, double *sums);

/* Mean level, V, of `count` chips on end, of which number `lead` is the first of the fit. */
void fit_levels(const struct fit_line *line, const struct fit *fit, double blur, size_t lead, size_t count,
                float *levels);

/* Values of scratch that fit_refine takes. */
size_t fit_scratch(const struct code *code);

/* Moves start and chip duration to where the level changes of the decided words are.
 *
 * Around edge j the area between line and model is (v[j−1] − v[j])·τ[j] for an edge that comes τ[j] late;
 * τ = δstart + j·δchip is fitted by least squares, in which big steps count most. This is repeated ever closer to the
 * edges, until nothing moves. earliest, latest: bounds of the start. Edges out of view are left out. */
struct fit fit_refine(const struct code *code, const struct fit_line *line, const struct fit_refining *refining,
                      struct certifier *certifier, struct fit fit, double earliest, double latest, float *scratch);

#endif
