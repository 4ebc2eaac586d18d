// SPDX-License-Identifier: Apache-2.0

/* Functions and constants that each microcontroller supplies to main.c and talk.c.
 *
 * Time is a running count of BOARD_TICKS_PER_US; its low 16 bits suffice for edges less than 65,536
 * ticks away. The output has a latch, which a timer match sets to a level at an exact time, and a
 * switch, the pin's direction, which connects the latch to the line or releases it.
 */
#ifndef NODE_NODE_BOARD_H
#define NODE_NODE_BOARD_H

#include <stdbool.h>
#include <stdint.h>

/* Inlined because cycles are counted after board_spin, and because a call makes an interrupt save all
 * registers. */
#define BOARD_INLINE inline __attribute__((always_inline))

/* For main.c; interrupts are on. */

/* Called first after a reset: sets up clocks, pins, timers and the watchdog. */
void board_init(void);
/* If it hears both: called next; whether the pin that hears sync pulses on the data wire is joined with it. */
bool board_is_joined(void);
/* … and then: whether they come there. has_led: the pin is wired accordingly, so that the LED's does no harm. */
void board_listen(bool on_data, bool has_led);
uint32_t board_now(void);
/* Sleeps until `when` or until *event is not 0. May return early. */
void board_sleep(uint32_t when, const volatile uint8_t *event);
/* Ratio of a sensor's voltage to the supply, in 1/1024; sensors count from 0. */
uint16_t board_measure(uint8_t sensor);
void board_led(bool on);
uint8_t board_memory_byte(uint16_t address);
/* Begins to change it; takes 3.4 ms, for which the next one waits. */
void board_memory_write(uint16_t address, uint8_t byte);
/* Returns a byte of the table in the node's flash (protocol.yaml); for BOARD_LARGE only. */
uint8_t board_flash_byte(uint16_t address);

/* For talk.c; inline, interrupts are off. The microcontroller's header also defines
 *
 *   BOARD_TICKS_PER_US   a power of two
 *   BOARD_ORDER          longest code row, chips
 *   BOARD_CHIP_NS        shortest chip that it can keep up with
 *   BOARD_LONGEST_CHIP_NS, BOARD_CHIP_STEP_NS    longest chip; all are a multiple of the step
 *   BOARD_BITS_RESTART   whether a sub-slot must be a bit
 *   BOARD_RESTART_US     shortest time from a sub-slot's end to the next: a restart's pulse begins 64 µs
 *                        before its sub-slot, and the line must be released by then
 *   BOARD_HEARS_OWN, BOARD_HEARS_DATA    whether it hears sync pulses on a wire of their own, on the data wire
 *   BOARD_MATCH_vect     interrupt of the latch's match
 *   BOARD_SYNC_vect      interrupt of the sync line's edges
 *   BOARD_SPIN_TICKS     shortest time to an edge that board_spin can wait for
 *   BOARD_SENSORS        1, or 4, whose words it sends at once: then no matches of the latch, below, are used
 *   BOARD_READING_US     time from the start of the reading to the next pulse: two conversions take 310 µs, those of four
 *                        sensors 416; the rest, chosen, is for clock, plan and interrupts
 *   BOARD_MEASURING_US   … from the frame's end: 100 µs more, and where a frame keeps the program busy also what it does
 *                        for the next one before it reads
 *   BOARD_LARGE          whether its flash has room for memories, and for telling of a wrong clock
 *   BOARD_LINE           pin of the line, on port B; of four the first one, BOARD_FIRST_LINE, on port D
 *   BOARD_LED, BOARD_LED_PORT    for avr.c
 */

/* Sets the latch to a level when the timer reaches `at`. False if it is too late for that. */
static BOARD_INLINE bool board_match(bool high, uint16_t at);
/* In the match's interrupt: whether this is the match asked for, not an intermediate one. */
static BOARD_INLINE bool board_match_is_last(void);
/* In that of an intermediate one: sets the timer for the next. False if it is too late for that. */
static BOARD_INLINE bool board_match_goes_on(void);
/* The level that the next match sets. */
static BOARD_INLINE bool board_match_level(void);
/* Sets the match to just before `at`: at `at` its flag is set, and nearly a full turn of the timer is
 * left to the next match. */
static BOARD_INLINE void board_match_past(uint16_t at);
/* Enables interrupts at matches, from the next one on. */
static BOARD_INLINE void board_matches_on(void);
static BOARD_INLINE void board_matches_off(void);
/* Sets the latch to a level at once, and the level of the next match. */
static BOARD_INLINE void board_latch(bool high);

/* Ticks until a time nearby, and since one. */
static BOARD_INLINE int16_t board_ticks_until(uint16_t at);
static BOARD_INLINE uint16_t board_ticks_since(uint16_t then);
/* Waits so that board_drive or board_release right after it takes effect exactly at `at`. */
static BOARD_INLINE void board_spin(uint16_t at);

/* Enables interrupts at edges of the sync line, from the next one on. */
static BOARD_INLINE void board_sync_on(void);
static BOARD_INLINE void board_sync_off(void);
/* In that interrupt: whether the edge is a rising one; sets *when to its time. */
static BOARD_INLINE bool board_sync_edge(uint32_t *when);
/* Whether a pulse that began at `rise` is over; sets *length, ticks: board_sync_over at the first look,
 * board_sync_fell after that. A pulse that ended too early to be measured counts as a short one, by an
 * ATtiny85 if one is due. */
static BOARD_INLINE bool board_sync_over(uint16_t rise, bool short_is_due, uint16_t *length);
static BOARD_INLINE bool board_sync_fell(uint16_t rise, uint16_t *length);

#if defined(__AVR_ATmega328P__)
#include "atmega328p.h"
#elif defined(__AVR_ATtiny85__)
#include "attiny85.h"
#else
#error "no such board"
#endif

#define BOARD_ROW (BOARD_ORDER / 8 + 1) /* octets of a row's place: chips_usart.c fetches one more than it sends */
/* Whether a node without a number may take one. That of several sensors is flashed with theirs. */
#define BOARD_TAKES_NUMBER (BOARD_LARGE && BOARD_SENSORS == 1)

/* A set of the node's sensors: bit s for sensor s. */
#if BOARD_SENSORS > 1
typedef uint8_t sensor_set;
#else
typedef bool sensor_set;

/* The switch. */
static BOARD_INLINE void board_drive(void)
{
    DDRB |= _BV(BOARD_LINE);
}

static BOARD_INLINE void board_release(void)
{
    DDRB &= (uint8_t)~_BV(BOARD_LINE);
}
#endif

#endif
