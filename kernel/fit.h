// SPDX-License-Identifier: Apache-2.0

/* A frame of a start and a chip duration: its chips, and where its edges are. What framing/fit.py does for
 * one candidate; in C because each is some twenty passes over a few hundred values, which take numpy
 * longer to begin than to make.
 *
 * Times are in samples; sample i is the line's level at instant i. */
#ifndef TACTILE_FIT_H
#define TACTILE_FIT_H

#include <stddef.h>
#include <stdint.h>

#include "transform.h"
#include "words.h"

/* Samples of a line, V, its level of rest, and sums of the samples without that: sums[i] is that of the first
 * i. At most 2³¹ − 1 samples. */
struct fit_line {
    size_t size;
    const double *volts, *sums;
    double level;
};

/* How frames are sent and read. flips: (k, N) of the scrambler, or NULL. places: (k·N) of the coded chips
 * among all `span` of a frame, rising. */
struct fit_code {
    struct words_frame frame;
    size_t span;
    const struct transform *correlate, *spread;
    const float *flips;
    const int32_t *places;
};

struct fit {
    double start, chip;
};

/* How a fit is refined; see fit_refine. reaches: of a chip on either side of an edge, in each turn. */
struct fit_refining {
    double blur, settled_chips;
    size_t turns;
    const double *reaches;
};

/* Running sums of `size` values without a level: size + 1, from 0 on. `sums` may be one before `values`. */
void fit_sums(const double *values, size_t size, double level, double *sums);

/* Mean level, V, of `count` chips on end, of which number `lead` is the first of the fit. */
void fit_levels(const struct fit_line *line, const struct fit *fit, double blur, size_t lead,
                size_t count, float *levels);

/* Mean square by which the level of `count` chips changes in their middle: from the mean of a share `inner` of a
 * chip before it to that behind it. */
double fit_turned(const struct fit_line *line, const struct fit *fit, double inner, double blur, size_t count);

/* The chips at `places` of these levels, without flips: (bits, N), of the first `bits` bits. */
void fit_chips(const struct fit_code *code, const float *levels, size_t bits, float *chips);

/* What rows hold that words of these amplitudes send, from what rows held: (bits, N). */
void fit_symbols(const struct fit_code *code, size_t bits, const float *rows, const float *amplitude,
                 float *symbols);

/* The line's chips from those that the code gives: with flips, and the level that unipolar nodes add. */
void fit_model(const struct fit_code *code, size_t bits, float pedestal, float *chips);

size_t fit_scratch(const struct fit_code *code);
/* Moves start and chip to where the level changes of the decided words are; `refine` in fit.py says how. scratch: so
 * many values. */
struct fit fit_refine(const struct fit_code *code, const struct fit_line *line,
                      const struct fit_refining *refining, struct fit fit, double earliest,
                      double latest, float *scratch);

/* The value of this rank, from 0; changes their order. Hoare's selection. */
float fit_ranked(float *values, ptrdiff_t size, ptrdiff_t rank);

#endif
