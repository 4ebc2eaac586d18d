// SPDX-License-Identifier: Apache-2.0

/* Schedules the pulses of the sync line: one before every frame and every restart within it, and before
 * a frame those that tell whose turn it is.
 *
 * An interrupt may call pulses_next at any time. It shares with the rest only flags, and words that
 * one side alone writes.
 */
#ifndef TACTILE_PULSES_H
#define TACTILE_PULSES_H

#include <stdbool.h>
#include <stdint.h>

#include "setup.h"

#define PULSES_AHEAD 32 /* frames that pulses may be ahead of the samples */

/* A pulse on the sync line. */
struct dg_pulse {
    uint64_t tick; /* of the stream, at its rising edge */
    uint8_t units; /* its length, in TP_SYNC_UNIT_US: TP_SYNC_FRAME or _RESTART */
};

struct pulses {
    volatile bool on;
    volatile uint8_t log2_asked;  /* of the groups, from the next frame on */
    volatile uint16_t number_asked; /* … and what is said of a number: a turn with its digits; 0: nothing */
    volatile uint8_t words_asked; /* how often all were asked to speak … */
    volatile uint8_t words_log2;  /* … the last time in so many turns */
    volatile uint8_t turn[PULSES_AHEAD]; /* of frame f at f % PULSES_AHEAD, with TP_TURN_ASKED */
    const struct setup *setup;
    uint64_t mark;                /* tick at which the present frame begins */
    uint32_t frame;               /* its number */
    uint32_t chip;                /* the chip that the next pulse announces */
    uint8_t log2_groups, group;   /* in force; the next frame's */
    uint8_t words_begun, words_left; /* how often they have begun to; frames in which they still do */
    bool announced;               /* some pulses of the next frame are taken: what they say is decided */
    uint16_t digits;              /* of its turn, whose pulses are to come */
};

/* Starts at the stream's first frame. The setup must not change until pulses_end. */
void pulses_begin(struct pulses *pulses, const struct setup *setup);
void pulses_end(struct pulses *pulses);

/* Divides the nodes into 2^log2_groups groups, from the next frame without a pulse on; pulses_end undoes it. */
void pulses_divide(struct pulses *pulses, uint8_t log2_groups);
/* Announces a number from the next frame without a pulse on, in place of groups; 0 with `forget` false, and
 * pulses_end, end that. */
void pulses_number(struct pulses *pulses, uint16_t number, bool forget);
/* Has all nodes speak from the next frame without a pulse on: in 2^log2_groups frames, or as many as there are
 * groups; pulses_end undoes it. */
void pulses_ask(struct pulses *pulses, uint8_t log2_groups);
/* The turn of a frame, whose pulse pulses_next has returned; 0: of all nodes. With TP_TURN_ASKED if all speak. */
uint8_t pulses_turn(const struct pulses *pulses, uint32_t frame);

/* Takes the next pulse; false if pulses are off. */
bool pulses_next(struct pulses *pulses, struct dg_pulse *pulse);

#endif
