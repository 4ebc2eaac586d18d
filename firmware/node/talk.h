// SPDX-License-Identifier: Apache-2.0

/* Transmits in interrupts: listens to the sync line, whose pulses start the chips of chips.h.
 *
 * main.c plans every frame before it begins. When a pulse ends, a few µs before the first chip, its
 * length tells whether it begins that frame; everything else has been prepared by then.
 */
#ifndef NODE_TALK_H
#define NODE_TALK_H

#include <stdbool.h>
#include <stdint.h>

#include "discipline.h"
#include "node_board.h"
#include "tactile_protocol.h"

struct talk_frame {
    uint32_t when;   /* time at which its pulse began */
    sensor_set others; /* those for which it is another group's turn, or announces a number */
    uint16_t turn;   /* the digits that say so: see turn.h */
    sensor_set spoke;  /* those whose planned code the node transmits in it */
};

/* Not 0: a frame has begun that talk_take has not yet returned. */
extern volatile uint8_t talk_began;
/* Not 0: there was a pulse since this was set to 0; for BOARD_LARGE only. */
extern volatile uint8_t talk_pulsed;

/* The record of the first sensor, and row as chips_init takes it. */
void talk_init(const struct tp_node_record *record, const uint8_t *row);

/* Tells when the next frame's pulse is due: those just before it say whose turn it is. */
void talk_expect(uint32_t when);

/* Plans the next frame: the sensors' codes, and whose to transmit in an ordinary frame (talks), and where its
 * number is announced or all are asked (answers). talk_stop must have released the line. */
void talk_plan(const struct discipline *clock, const uint16_t *codes, sensor_set talks, sensor_set answers);

/* Releases the line and discards the plan. */
void talk_stop(void);

/* Returns the frame that has begun. */
struct talk_frame talk_take(void);

#endif
