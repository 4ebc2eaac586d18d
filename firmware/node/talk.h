// SPDX-License-Identifier: Apache-2.0

/* Talking: what a node does in interrupts, from the edges of the sync line to those of its own.
 *
 * main.c makes a plan for every frame before it begins. Whether a pulse begins it is told here when
 * the pulse ends, a few µs before the first chip: only levels and times are left to be done then.
 */
#ifndef NODE_TALK_H
#define NODE_TALK_H

#include <stdbool.h>
#include <stdint.h>

#include "discipline.h"
#include "tactile_protocol.h"

struct talk_frame {
    uint32_t when;   /* its pulse began */
    uint8_t units;   /* the pulse's length: TP_SYNC_FRAME or TP_SYNC_CALL */
    bool spoke;      /* whether the plan's code is said in it */
};

/* A frame has begun that talk_take has not been asked about: not 0. */
extern volatile uint8_t talk_began;

void talk_init(const struct tp_node_record *record, const uint8_t *row);

/* For the next frame: what to say, and whether, in an ordinary frame and in a roll call's first.
 * The line must have been released by talk_stop. */
void talk_plan(const struct discipline *clock, uint16_t code, bool talks, bool talks_first);

/* Releases the line, and forgets the plan. */
void talk_stop(void);

/* The frame that has begun. */
struct talk_frame talk_take(void);

#endif
