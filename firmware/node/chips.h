// SPDX-License-Identifier: Apache-2.0

/* Puts the chips of a word on the line, one sub-slot after the other: chips_match.c by matches of a
 * timer, chips_usart.c by a shift register, for chips that are too short for an interrupt each.
 */
#ifndef NODE_CHIPS_H
#define NODE_CHIPS_H

#include <stdbool.h>
#include <stdint.h>

#include "discipline.h"
#include "tactile_protocol.h"

/* row: the record's; it stays in use. Several sensors have records one behind the other, and rows, every BOARD_ROW
 * octets. */
void chips_init(const struct tp_node_record *record, const uint8_t *row);

/* Prepares a word for each sensor, the lowest bits of its code. chips_stop must have released the line. */
void chips_plan(const struct discipline *clock, const uint16_t *codes);

/* With several sensors: says which of them transmit their words in the frame that begins next. */
void chips_choose(uint8_t sensors);

/* How a sub-slot begins, and when chips_begin has to begin. */
struct chips_start {
    uint16_t at;
#ifdef NODE_FAST
    uint16_t more;                  /* octets but for the first */
    uint8_t guard, first, second;   /* octets to begin with */
    uint8_t divider, wait;          /* UBRR0, and turns of 4 cycles until it is written */
#endif
};

/* For interrupts. Prepares the sub-slot that a pulse announces, which began at `rise`. */
struct chips_start chips_aim(uint32_t rise);
/* Begins the sub-slot then, and listens to the sync line again after it. False if it is too late. */
bool chips_begin(struct chips_start start);

/* Has it worked out here, in registers. */
static inline __attribute__((always_inline)) void chips_hold(struct chips_start *start)
{
    __asm__ volatile("" : "+r"(start->at));
#ifdef NODE_FAST
    __asm__ volatile("" : "+r"(start->more), "+r"(start->guard), "+r"(start->first),
                          "+r"(start->second), "+r"(start->divider), "+r"(start->wait));
#endif
}

/* Whether the line is released until a restart pulse comes. */
bool chips_paused(void);

/* Releases the line and discards the word; interrupts are off. */
void chips_stop(void);

#endif
