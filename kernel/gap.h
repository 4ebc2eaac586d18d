// SPDX-License-Identifier: Apache-2.0

/* The next frame of a stream without marks, where the raster says where it is: GapTiming._look in
 * tactile_cdma/framing as far as nothing is doubtful. In C, and in one call, because this is nearly every frame of
 * such a stream, and numpy and Python take ten times as long for it. Whatever is not so clear is left to them. */
#ifndef TACTILE_GAP_H
#define TACTILE_GAP_H

#include "burst.h"
#include "judge.h"

#define GAP_MOST 16 /* candidates; where more are possible, Python looks */

/* As `Limits` in limits.py and constants of gap.py, raster.py, judge.py, fit.py and stray.py. shortest, longest:
 * frames, samples; bit: of nominal chips. near, far: BESIDE_CHIPS. spare, spare_count: rows that show the noise.
 * twins: whether a node out of time may be taken for another one. */
struct gap_rules {
    double shortest, longest, bit, period;
    double beyond, carried_noise, carried_misfit, doubt, disturbed, wide, ruled_out, settled_chips;
    double still_misfit, least_chip, uneven, spread, left, misfit;
    double faint, near, far, beside, perhaps, inner, turned, scatter, stray_left, clear;
    size_t most_turned, spare, spare_count;
    bool twins;
};

/* As Expected; chip: 0 where no frame is surely expected. */
struct gap_expected {
    double start, scatter, chip, slips;
};

enum gap_look {
    GAP_SILENT, /* nothing but noise */
    GAP_UNSURE, /* a burst, and perhaps another one before it */
    GAP_BURST,  /* what it is, has to be looked at more closely */
    GAP_FRAME,  /* a frame beyond doubt */
};

/* proven: until which sample silence has to last to prove that the frame is over; 0 where none is carried.
 * unaided: whether the waveform alone places the frame. sound: its words are even, and leave nothing over, the
 * line is at rest beside it, and nothing shows a node out of time; then noise: of a row's levels, V. words: of one candidate, as in judge_found. */
struct gap_seen {
    struct burst_gap gap;
    struct burst_found burst;
    double proven;
    struct fit fit;
    bool unaided, sound;
    struct burst_beside beside;
    double noise;
    struct judge_found words;
};

/* Values that gap_look works in: of `samples` double, and of float. */
size_t gap_values(const struct burst_search *search, size_t samples);
size_t gap_scratch(const struct fit_code *code, const struct burst_search *search);

/* False where the samples are too few for a gap, or one is NaN. */
bool gap_look(const struct fit_code *code, const struct burst_search *search,
              const struct judge_limits *limits, const struct gap_rules *rules,
              const double *reaches, size_t turns, const double *volts, size_t size,
              double least_power, const struct burst_gap *known, const struct gap_expected *expected,
              struct gap_seen *seen, enum gap_look *look, double *values, float *scratch);

#endif
