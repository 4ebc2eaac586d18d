// SPDX-License-Identifier: Apache-2.0

/* The next frame of a stream without marks, where the raster says where it is: GapTiming._searched in
 * tactile_cdma/framing as far as nothing is doubtful. In C, and in one call, because this is nearly every frame of
 * such a stream, and numpy and Python take ten times as long for it. Whatever is not so clear is left to them. */
#ifndef TACTILE_GAP_H
#define TACTILE_GAP_H

#include "burst.h"
#include "judge.h"

/* As `Limits` in limits.py and constants of search.py, raster.py, judge.py, fit.py and stray.py. shortest, longest:
 * frames, samples; bit: of nominal chips. rail_low, rail_high: V. near, far: BESIDE_CHIPS.
 * spare, spare_count: rows that show the noise. twins: whether a node out of time may be taken for another one. */
struct gap_rules {
    struct judge_limits judge;
    double blur, settled_chips, shortest, longest, bit, period;
    double beyond, carried_noise, carried_misfit, doubt, disturbed, wide, ruled_out;
    double rail_low, rail_high, deafened, still_misfit, least_chip, uneven, spread, left, misfit;
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
 * unaided: whether the waveform alone places the frame. clipped: share of its samples at a rail. sound: its words are
 * even, and leave nothing over, the line is at rest beside it, nothing shows a node out of time, and no rail hides one;
 * then noise: of a row's levels, V. */
struct gap_seen {
    struct burst_gap gap;
    struct burst_found burst;
    double proven;
    struct fit fit;
    bool unaided, sound;
    struct burst_beside beside;
    double clipped, noise;
    struct judge_words words;
};

/* Values that gap_look works in: of `samples` double, and of float. */
size_t gap_values(const struct burst_search *search, size_t samples);
size_t gap_scratch(const struct fit_code *code, const struct burst_search *search);

/* volts: as searched. raw: as they came, with hum. False where the samples are too few for a gap, or one is NaN. */
bool gap_look(const struct fit_code *code, const struct burst_search *search, const struct gap_rules *rules,
              const struct fit_refining *refining, const double *volts, const double *raw, size_t size,
              double least_power, const struct burst_gap *known, const struct gap_expected *expected,
              struct gap_seen *seen, enum gap_look *look, double *values, float *scratch);

#endif
