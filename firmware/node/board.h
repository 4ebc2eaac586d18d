// SPDX-License-Identifier: Apache-2.0

/* What a node's board does for main.c and talk.c.
 *
 * Time is a count of BOARD_TICKS_PER_US that never stops; 16 bits of it do where an edge is less than
 * 65,536 ticks away. The output has a latch, which a match of the timer sets to a level at an exact
 * time, and a switch, the pin's direction, which puts the latch on the line or releases it.
 */
#ifndef NODE_BOARD_H
#define NODE_BOARD_H

#include <stdbool.h>
#include <stdint.h>

/* Cycles are counted from board_spin on; and a call costs an interrupt all registers. */
#define BOARD_INLINE inline __attribute__((always_inline))

/* For main.c, interrupts on. */

/* First thing after a reset: clocks, pins, timers, watchdog. */
void board_init(void);
uint32_t board_now(void);
/* Sleeps until an interrupt, but not beyond `when`, and not if *event isn't 0. May return early. */
void board_sleep(uint32_t when, const volatile uint8_t *event);
/* The sensor's voltage over the supply's, in 1/1024. */
uint16_t board_measure(void);
void board_led(bool on);
uint8_t board_memory_byte(uint16_t address);

/* For talk.c: inline, interrupts off. The board's header has besides
 *
 *   BOARD_TICKS_PER_US   a power of two
 *   BOARD_ORDER          most chips of a row
 *   BOARD_CHIP_NS        least duration of a chip, for which its interrupts leave time
 *   BOARD_MATCH_vect     interrupt of the latch's match
 *   BOARD_SYNC_vect      interrupt of the sync line's edges
 *   BOARD_SPIN_TICKS     least way to what board_spin waits for
 *   BOARD_LINE           pin of the line, on port B
 *   BOARD_LED, BOARD_LED_PORT    for avr.c
 */

/* The latch gets a level when the timer gets to `at`. False: it is too late for that. */
static BOARD_INLINE bool board_match(bool high, uint16_t at);
/* In the match's interrupt: whether it was the one that was asked for, not one on the way. */
static BOARD_INLINE bool board_match_is_last(void);
/* Level that the next match will set. */
static BOARD_INLINE bool board_match_level(void);
/* At `at` the last match is over, its flag is up, and nearly a turn of the timer is left to the next
 * one. */
static BOARD_INLINE void board_match_past(uint16_t at);
/* Interrupts at matches, from the next one on. */
static BOARD_INLINE void board_matches_on(void);
static BOARD_INLINE void board_matches_off(void);
/* The latch, and the next match, get a level at once. */
static BOARD_INLINE void board_latch(bool high);

/* The switch: below. */
static BOARD_INLINE void board_drive(void);
static BOARD_INLINE void board_release(void);
/* Ticks until a near time, and since one. */
static BOARD_INLINE int16_t board_ticks_until(uint16_t at);
static BOARD_INLINE uint16_t board_ticks_since(uint16_t then);
/* Waits, to the cycle, so that board_drive or board_release right after it takes effect at `at`. */
static BOARD_INLINE void board_spin(uint16_t at);

/* Interrupts at edges of the sync line, from the next one on. */
static BOARD_INLINE void board_sync_on(void);
static BOARD_INLINE void board_sync_off(void);
/* In that interrupt: whether the edge was a rising one, and when it came. */
static BOARD_INLINE bool board_sync_edge(uint32_t *when);
/* The first look at a pulse that began at `rise`, and further ones: whether it is over, and its
 * length in ticks. What was over before that could be measured is taken for a short one if a short
 * one is due. */
static BOARD_INLINE bool board_sync_over(uint16_t rise, bool short_is_due, uint16_t *length);
static BOARD_INLINE bool board_sync_fell(uint16_t rise, uint16_t *length);

#if defined(__AVR_ATmega328P__)
#include "atmega328p.h"
#elif defined(__AVR_ATtiny85__)
#include "attiny85.h"
#else
#error "no such board"
#endif

static BOARD_INLINE void board_drive(void)
{
    DDRB |= _BV(BOARD_LINE);
}

static BOARD_INLINE void board_release(void)
{
    DDRB &= (uint8_t)~_BV(BOARD_LINE);
}

#endif
