// SPDX-License-Identifier: Apache-2.0

/* A marked frame → what it says, by the timing of an earlier one: MarkedLine.gate, and
 * LineRecogniser._by_carried or _integrated in tactile_cdma/framing, as far as nothing about the frame is doubtful. */
#ifndef TACTILE_CARRIED_H
#define TACTILE_CARRIED_H

#include <stdbool.h>
#include <stddef.h>

#include "samples.h"
#include "transform.h"
#include "words.h"

/* Of every frame of a stream; shares and factors as `Limits` in limits.py. */
struct carried_line {
    struct words_frame frame;
    size_t spare, spare_count; /* rows that show the noise */
    size_t size;               /* samples of an unstretched frame */
    double chip;               /* nominal, samples */
    double least_power;        /* of a frame in which somebody speaks, V² */
    double most_noise;         /* of a chip, V, in which no word is missed; infinite if unknown */
    double rail_low, rail_high; /* V: samples at these, or beyond, are clipped */
    double deafened, carried_noise, carried_misfit, loud;
    bool integrated;     /* samples are chips; there is no timing, and no gap: then besides */
    bool mean_is_offset; /* of a frame */
    size_t heard;        /* samples of the frame */
    double spread, misfit, left;
    const struct transform *transform; /* from chips to rows; of the frame's order */
};

/* The timing of an earlier frame. */
struct carried_fit {
    double chip; /* samples */
    struct samples_edges edges;
    const int32_t *places;     /* of the bits·order chips among the edges */
    size_t heard;              /* samples of the frame */
    size_t tail, tail_samples; /* where the line is at rest after it */
};

/* What the line was when nobody spoke: its level, V, and the variance of a chip's level, V². */
struct carried_rest {
    double level, noise;
};

struct carried_found {
    double level;   /* of the line at rest, V */
    double noise;   /* V RMS: of a chip in a silent frame, of one correlation in another */
    double clipped; /* share of its samples */
};

enum carried {
    CARRIED_UNDECIDED, /* it has to be looked at more closely */
    CARRIED_SILENT,
    CARRIED_HEARD,
};

/* volts: (count,) from the mark on, at least `size`; NaN where absurd. fit: NULL where there is none,
 * or none is needed.
 * rows: (k, N), written to. scratch: (2, n). */
enum carried carried_read(const struct carried_line *line, const struct carried_fit *fit,
                          const struct carried_rest *rest, const double *volts, size_t count,
                          float *rows, float *scratch, struct carried_found *found);

#endif
