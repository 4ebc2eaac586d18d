// SPDX-License-Identifier: Apache-2.0

/* Decides marked frames that leave nothing to decide: in which nobody spoke, or which the timing of an
 * earlier one explains. It is what MarkedLine.gate, and LineRecogniser._by_carried or _integrated in
 * tactile_cdma/framing, do then; of any other frame it says why it is in doubt.
 *
 * In C because nearly all frames are such, and numpy takes ten times as long for small ones: most of it
 * between its functions. */
#ifndef TACTILE_MARKED_FRAME_H
#define TACTILE_MARKED_FRAME_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "sparse.h"
#include "transform.h"
#include "words.h"

/* ---- samples → chips: the sums of tactile_cdma/base/sums.py and framing/fit.py ------------------- */

/* Counts of a converter as volts: (count − zero)·per_count, in float; those not within ±most, V, become NaN. */
void samples_volts(const int16_t *counts, size_t size, float zero, float per_count, float most, float *volts);

/* What samples add up to: their sum and the sum of their squares. */
struct samples_sums {
    double sum, squares;
};

struct samples_sums samples_add(const float *volts, size_t size);
struct samples_sums samples_add_wide(const double *volts, size_t size);

/* How many samples are not between two levels: at either, or beyond. */
size_t samples_outside(const float *volts, size_t size, double low, double high);

/* Edges of chips in samples: how many whole samples come before each of `count` edges, the share of the
 * next one, and the number of samples between edges; see ChipEdges in fit.py. */
struct samples_edges {
    size_t count;
    const int32_t *whole; /* rising, below the number of samples */
    const double *share, *number;
};

/* Mean level between edges, but for `level`, of `size` chips, which begin at these edges (rising). False
 * where the edges are not within `samples` samples, or the places not within the edges. */
bool samples_chips(const float *volts, size_t samples, double level,
                   const struct samples_edges *edges, const int32_t *places, size_t size, float *chips);

/* ---- frames ------------------------------------------------------------------------------------- */

/* Of every frame of a stream; shares and factors as `Limits` in limits.py. */
struct frame_rules {
    struct words_frame frame;
    size_t spare, spare_count; /* rows that show the noise */
    size_t size;               /* samples of an unstretched frame */
    size_t whole_size;         /* those in which it is looked for clipping, if samples are chips */
    double chip;               /* nominal, samples */
    double least_power;        /* of a frame in which somebody speaks, V² */
    double silent_power;       /* below which nobody does, however faintly, V² */
    double most_noise;         /* of a chip, V, in which no word is missed; infinite if unknown */
    double rail_low, rail_high; /* V: samples at these, or beyond, are clipped */
    double deafened, carried_noise, carried_misfit, loud;
    double spread, misfit, left, clear_spread, chips, few, whole, hiding, kept, rest, at_rest;
    double tail_noise, tail_scatter, tail_level, least_tail;
    bool integrated;     /* samples are chips; there is no timing, and no gap */
    bool mean_is_offset; /* of a frame, until a gap has shown it */
    bool scrambled;
    double noise_share;              /* of the noise, which is no node either; see MarkedLine.gate */
    double most_silent_noise;        /* of that no more, V² */
    double silent_rise, silent_more; /* by which noise may exceed that of the gap, if scrambled; V² */
};

/* What does it. */
struct frame_code {
    const struct transform *transform; /* from chips to rows; NULL: none of this order */
    const float *flips;                /* (k, N), of a scrambled frame's chips */
    struct sparse *sparse;             /* what takes sparse codes apart; NULL: codes are orthogonal */
    int32_t *spoke;                    /* (n) nodes that spoke, of sparse codes */
};

/* The timing of an earlier frame. */
struct frame_timing {
    double chip, until;    /* samples; until: those that show the line at rest after it */
    size_t heard;          /* samples of the frame */
    size_t tail, tail_end; /* where the line is at rest after it */
};

/* Where its chips are. */
struct frame_edges {
    struct samples_edges all;
    const int32_t *places; /* of the bits·order chips among the edges */
};

/* What the line was when nobody spoke: its level, V, and the variance of a chip's level, V². */
struct frame_rest {
    double level, noise;
    bool known;
};

struct frame_found {
    double level;   /* of the line at rest, V */
    double noise;   /* V RMS: of a chip in a silent frame, of one correlation in another */
    double clipped; /* share of its samples */
    bool ended;     /* the line was seen at rest after it */
    size_t more;    /* samples that show the line at rest after it */
    double rest;    /* noise of the line, as in frame_rest, after it */
    size_t speakers; /* of sparse codes */
};

enum frame_look {
    FRAME_SILENT,
    FRAME_HEARD,
    FRAME_NEEDS_MORE,   /* it is explained, but not all samples are there that show its end */
    FRAME_CUT_SHORT,    /* in doubt since: fewer samples than a frame has */
    FRAME_ABSURD,       /* a sample is */
    FRAME_CLIPPED,      /* many are */
    FRAME_NOISY,        /* words might not show */
    FRAME_UNKNOWN_REST, /* the level of the line at rest is not known yet */
    FRAME_NO_TIMING,    /* there is none to try, or it was used often enough */
    FRAME_UNEXPLAINED,  /* words leave more than noise */
    FRAME_NOT_AT_REST,  /* something follows it */
};

/* volts: (count,) from the mark on; NaN where absurd. timing: NULL where there is none. final: no more
 * will follow. rows: (k, N), written to. scratch: (2, n). */
enum frame_look frame_read(const struct frame_rules *rules, const struct frame_code *code,
                           const struct frame_timing *timing, const struct frame_edges *edges,
                           const struct frame_rest *rest, const float *volts, size_t count,
                           bool final, float *rows, float *scratch, struct frame_found *found);

/* A frame, or more, in which no node transmitted, of which only mean, V, and variance, V², are known. */
enum frame_look frame_summed_up(const struct frame_rules *rules, const struct frame_rest *rest,
                                double mean, double variance, struct frame_found *found);

#endif
