// SPDX-License-Identifier: Apache-2.0

/* When the sync line pulses: before every frame, and before every restart of the nodes in it.
 *
 * The one part of the digitizer that an interrupt may call, between any two instructions of the
 * rest. What both touch is a flag, or a word that only one of them writes.
 */
#ifndef TACTILE_PULSES_H
#define TACTILE_PULSES_H

#include <stdbool.h>
#include <stdint.h>

#include "setup.h"

#define PULSES_AHEAD 32 /* frames by which pulses may be ahead of the samples */

/* A pulse on the sync line. */
struct dg_pulse {
    uint64_t tick; /* of its rising edge, in the stream */
    uint8_t units; /* its length, in TP_SYNC_UNIT_US: TP_SYNC_FRAME, _CALL or _RESTART */
};

struct pulses {
    volatile bool on;
    volatile bool call_asked;     /* and not yet begun */
    volatile uint32_t called;     /* bit f: frame f, modulo PULSES_AHEAD, is of a roll call */
    const struct setup *setup;
    uint64_t mark;                /* tick of the frame that pulses are given out for */
    uint32_t frame;               /* its number */
    uint32_t chip;                /* that the next pulse announces */
    uint32_t turns;               /* frames of a roll call to come */
};

/* From the stream's first frame on. The setup must last as long as they are on. */
void pulses_begin(struct pulses *pulses, const struct setup *setup);
void pulses_end(struct pulses *pulses);

/* A roll call, with the next frame that no pulse was given out for; pulses_end forgets it. */
void pulses_call(struct pulses *pulses);
/* Whether a frame is of one; its pulse was given out. */
bool pulses_called(const struct pulses *pulses, uint32_t frame);

bool pulses_next(struct pulses *pulses, struct dg_pulse *pulse);

#endif
