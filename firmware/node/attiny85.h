// SPDX-License-Identifier: Apache-2.0

/* ATtiny85 at 8 MHz (its RC oscillator, up to 10 % off): sync on PB2 (INT0), line on PB1 (OC1A), sensor
 * on PB3 (ADC3), LED on PB4. With NODE_DATA sync pulses come on the data wire, whose pin is the comparator's AIN1, too:
 * its interrupt takes the place of INT0's, and PB2 stays unconnected.
 *
 * Timer1 counts pairs of cycles and generates the edges of the line; its 8 bits wrap every 64 µs.
 * Timer0, started with it, counts 256 cycles at a time and tells the wraps apart. There is no capture
 * unit: the first instructions of the interrupt time an edge of the sync line. Their delay is constant
 * if the processor sleeps, as it does when a pulse is due.
 *
 * Fuses: no division by 8, brown-out at 2.7 V, EEPROM kept when the chip is erased
 * (low 0xE2, high 0xD5, extended 0xFF).
 */
#ifndef NODE_ATTINY85_H
#define NODE_ATTINY85_H

#include <avr/interrupt.h>
#include <avr/io.h>

#include "node_memory.h"

#define BOARD_TICKS_PER_US 4u
#define BOARD_MATCH_vect TIMER1_COMPA_vect
#define BOARD_SYNC_vect __vector_sync_edge /* INT0's interrupt jumps to it, see attiny85.c */

#define BOARD_ORDER 1024     /* 128 bytes of the 512 bytes of EEPROM, and of RAM */
#define BOARD_CHIP_NS 40000u /* shortest that test_node_image.py runs without a wrong edge */
#define BOARD_SCRAMBLED_CHIP_NS 40000u
#define BOARD_SPARSE_CHIP_NS 0u
#define BOARD_LONGEST_CHIP_NS 1000000u
#define BOARD_CHIP_STEP_NS 1u
#define BOARD_BITS_RESTART false
#define BOARD_RESTART_US 96u
#ifdef NODE_DATA /* its flash has no room for both */
#define BOARD_HEARS_OWN false
#define BOARD_HEARS_DATA true
#else
#define BOARD_HEARS_OWN true
#define BOARD_HEARS_DATA false
#endif

#define BOARD_LARGE false
#define BOARD_SENSORS 1
#define BOARD_READING_US 800u
#define BOARD_MEASURING_US 900u
#define BOARD_LINE PB1
#define BOARD_SYNC PB2
#define BOARD_SENSOR PB3
#define BOARD_LED PB4
#define BOARD_LED_PORT PORTB

/* Ticks from an edge to its interrupt's reading of Timer1: 4 cycles to wake, 4 to enter, 4 of
 * instructions. (The pin's synchroniser takes 2 or 3 more, as an ATmega328P's does.) */
#ifdef NODE_DATA
#define BOARD_SYNC_LATENCY 10u /* and 1 µs of resistor and comparator, as an ATmega328P's */
#else
#define BOARD_SYNC_LATENCY 6u
#endif

/* Longest time to a match, ticks. Longer times are divided into steps of at least half of this, which is as long as
 * the shortest chip: both interrupts of a chip end in the shortest time that is divided, or in two of those chips. */
#define BOARD_MATCH_REACH (BOARD_CHIP_NS / 500u * BOARD_TICKS_PER_US)

#define BOARD_COUNTING _BV(CS11) /* of TCCR1: a tick is 2 cycles */

/* Ticks at Timer0's last wrap, or the one before. board_now updates it, because an interrupt for it
 * could delay that of a pulse. */
extern uint32_t board_ticks;
/* State of a match that is reached in steps. */
extern uint16_t board_match_here, board_match_at;
extern bool board_match_high;

/* Time of a recent count of Timer1; interrupts are off. */
static BOARD_INLINE uint32_t board_time(uint8_t count)
{
    uint32_t coarse = board_ticks;
    uint8_t wraps = TCNT0;

    if (TIFR & _BV(TOV0)) {
        coarse += 0x8000u; /* not yet counted by board_now */
        wraps = TCNT0;     /* the first reading may be of before the wrap */
    }
    coarse += (uint16_t)wraps << 7;
    /* Timer1 gives the low 8 bits; it is 0 to 128 ticks ahead of Timer0, so adding 64 tells its wraps */
    return coarse + 64u + (int8_t)(uint8_t)(count - (uint8_t)coarse - 64u);
}

static BOARD_INLINE void board_level(bool high)
{
    TCCR1 = high ? BOARD_COUNTING | _BV(COM1A1) | _BV(COM1A0) : BOARD_COUNTING | _BV(COM1A1);
}

static BOARD_INLINE bool board_match_goes_on(void)
{
    uint16_t step = board_match_at - board_match_here;

    if (step > BOARD_MATCH_REACH)
        step = step < 2 * BOARD_MATCH_REACH ? step / 2 : BOARD_MATCH_REACH;
    else
        board_level(board_match_high);
    /* Timer1 comes to the counts of its next turn twice: the first time has to be over */
    uint8_t from = (uint8_t)board_match_here, early = (uint8_t)(step > 256u ? step : 0);
    while ((uint8_t)(TCNT1 - from) <= early)
        ;
    board_match_here += step;
    OCR1A = (uint8_t)(board_match_here - 1u);
    /* the count read is up to a tick old, and OCR1A takes up to a tick to reach Timer1 */
    return (uint8_t)(TCNT1 - from - early) < (uint8_t)(step - early - 3u);
}

static BOARD_INLINE bool board_match(bool high, uint16_t at)
{
    board_match_high = high;
    board_match_at = at;
    return board_match_goes_on();
}

static BOARD_INLINE bool board_match_is_last(void)
{
    return board_match_here == board_match_at;
}

static BOARD_INLINE bool board_match_level(void)
{
    return TCCR1 & _BV(COM1A0);
}

static BOARD_INLINE void board_latch(bool high)
{
    board_level(high);
    GTCCR = _BV(FOC1A);
}

static BOARD_INLINE void board_match_past(uint16_t at)
{
    board_match_here = board_match_at = at;
    OCR1A = (uint8_t)(at - 16u);
}

static BOARD_INLINE void board_matches_on(void)
{
    TIFR = _BV(OCF1A);
    TIMSK |= _BV(OCIE1A);
}

static BOARD_INLINE void board_matches_off(void)
{
    TIMSK &= (uint8_t)~_BV(OCIE1A);
}

static BOARD_INLINE bool board_on_data(void)
{
    return false;
}

static BOARD_INLINE bool board_has_led(void)
{
    return true;
}

#ifdef NODE_DATA
#define BOARD_LEVEL ACSR
#define BOARD_LEVEL_BIT ACO

static BOARD_INLINE void board_sync_on(void)
{
    ACSR = _BV(ACBG) | _BV(ACI) | _BV(ACIE); /* at either edge of the comparator's output */
}

static BOARD_INLINE void board_sync_off(void)
{
    ACSR = _BV(ACBG);
}
#else
#define BOARD_LEVEL PINB
#define BOARD_LEVEL_BIT BOARD_SYNC

static BOARD_INLINE void board_sync_on(void)
{
    GIFR = _BV(INTF0);
    GIMSK = _BV(INT0);
}

static BOARD_INLINE void board_sync_off(void)
{
    GIMSK = 0;
}
#endif

static BOARD_INLINE bool board_sync_edge(uint32_t *when)
{
    *when = board_time(GPIOR0) - BOARD_SYNC_LATENCY;
    return GPIOR1 & _BV(BOARD_LEVEL_BIT);
}

static BOARD_INLINE bool board_sync_fell(uint16_t rise, uint16_t *length)
{
    *length = (uint8_t)(TCNT1 - (uint8_t)rise);
    return !(BOARD_LEVEL & _BV(BOARD_LEVEL_BIT));
}

/* Looks 20 µs or more after the rising edge: a pulse that is over by then counts as a restart pulse,
 * even if it is noise of 2 to 8 µs. */
static BOARD_INLINE bool board_sync_over(uint16_t rise, bool short_is_due, uint16_t *length)
{
    const uint8_t unit = TP_SYNC_UNIT_US * BOARD_TICKS_PER_US;
    bool over = board_sync_fell(rise, length);

    if (short_is_due || *length < 2 * unit - unit / 4)
        *length = unit;
    return over;
}

/* From 24 ticks ago to 231 ahead. */
static BOARD_INLINE int16_t board_ticks_until(uint16_t at)
{
    uint8_t left = (uint8_t)((uint8_t)at - TCNT1);

    return left < 232u ? left : (int16_t)(left - 256);
}

/* Up to 255. */
static BOARD_INLINE uint16_t board_ticks_since(uint16_t then)
{
    return (uint8_t)(TCNT1 - (uint8_t)then);
}

#define BOARD_SPIN_TICKS 20
static BOARD_INLINE void board_spin(uint16_t at)
{
    uint8_t left = (uint8_t)at, odd;

    while (board_ticks_until(at) > 3 * BOARD_SPIN_TICKS)
        ;
    /* Two readings, a cycle apart, tell the cycle t: twice the first one, and 1 more if they differ.
     * It leaves 2·at - t cycles, of which the instructions here take 16 and the one that follows 2. */
    __asm__ volatile("in __tmp_reg__, %[count]  \n\t"
                     "in %[odd], %[count]       \n\t"
                     "sub %[odd], __tmp_reg__   \n\t"
                     "sub %[left], __tmp_reg__  \n\t"
                     "lsl %[left]               \n\t"
                     "sub %[left], %[odd]       \n\t"
                     "subi %[left], 18          \n\t"
                     "1: subi %[left], 4        \n\t" /* 4 cycles each, 3 the last time */
                     "nop                       \n\t"
                     "brcc 1b                   \n\t"
                     "sbrc %[left], 0           \n\t" /* 2 cycles, or 3 */
                     "rjmp 2f                   \n\t"
                     "2: sbrc %[left], 1        \n\t" /* and for twice as much two of them */
                     "rjmp 3f                   \n\t"
                     "3: sbrc %[left], 1        \n\t"
                     "rjmp 4f                   \n\t"
                     "4:                        \n\t"
                     : [left] "+d"(left), [odd] "=&r"(odd)
                     : [count] "I"(_SFR_IO_ADDR(TCNT1)));
}

#endif
