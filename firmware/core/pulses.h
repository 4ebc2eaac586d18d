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

#define PULSES_STRAYED 3 /* frames in a row that are too far off for those that are heard. Chosen */

/* A pulse on the sync line. */
struct dg_pulse {
    uint64_t tick; /* of the stream, at its rising edge */
    uint8_t units; /* its length, in TP_SYNC_UNIT_US: TP_SYNC_FRAME or _RESTART */
};

/* A place in the sequence of pulses. */
struct pulse_walk {
    uint64_t mark;    /* tick at which the present frame begins */
    uint32_t frame;   /* its number */
    uint32_t chip;    /* the chip that the next pulse announces */
    bool announced;   /* what the frame's pulses say is known */
    uint16_t digits;  /* of its turn, whose pulses are to come */
};

struct pulses {
    volatile bool on;
    volatile uint8_t log2_asked;  /* of the groups, from the next frame on */
    volatile uint16_t number_asked; /* … and what is said of a number: a turn with its digits; 0: nothing */
    volatile uint8_t words_asked; /* how often all were asked to speak … */
    volatile uint8_t words_log2;  /* … the last time in so many turns */
    volatile uint16_t digits[PULSES_AHEAD]; /* that come before frame f, at f % PULSES_AHEAD */
    /* Where another digitizer's frames are heard: */
    volatile int8_t moved[PULSES_AHEAD]; /* samples by which frame f is later, at f % PULSES_AHEAD */
    volatile uint32_t heard_us;          /* when its last frame began, modulo 2³² */
    volatile bool is_heard;
    volatile uint8_t strayed;            /* frames in a row */
    volatile uint32_t unheard;           /* frames without one of its, since power-up */
    uint32_t start_us;                   /* of tick 0, modulo 2³² */
    const struct setup *setup;
    struct pulse_walk walk;       /* to the next pulse */
    uint8_t log2_groups, group;   /* in force; the next frame's */
    uint8_t words_begun, words_left; /* how often they have begun to; frames in which they still do */
};

/* Starts at the stream's first frame; its tick 0 is at start_us. The setup must not change until pulses_end. */
void pulses_begin(struct pulses *pulses, const struct setup *setup, uint64_t start_us);
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

/* Another digitizer's frame begins at this time, modulo 2³². */
void pulses_heard(struct pulses *pulses, uint32_t us);
/* The first tick from the earliest one on at which another digitizer's frame begins, if those are heard; else the
 * earliest one. Rounded up to a sample. */
uint64_t pulses_first_mark(const struct pulses *pulses, const struct setup *setup, uint64_t start_us);
/* Samples by which a frame is later than a period after the one before; its first pulse is known. */
int8_t pulses_moved(const struct pulses *pulses, uint32_t frame);
/* Frames are so far off those that are heard that the stream has to begin anew. */
bool pulses_strayed(const struct pulses *pulses);

/* Takes the next pulse; false if pulses are off. */
bool pulses_next(struct pulses *pulses, struct dg_pulse *pulse);

/* The same pulses once more, for who follows: from the first one on, each after pulses_next has taken it. */
struct pulse_walk pulses_first(const struct setup *setup);
void pulses_follow(const struct pulses *pulses, struct pulse_walk *walk, struct dg_pulse *pulse);

#endif
