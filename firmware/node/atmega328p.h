// SPDX-License-Identifier: Apache-2.0

/* ATmega328P at 8 MHz (crystal, or half of one of 16 MHz), 3.3 V: sync on PB0 (ICP1), line on PB1 (OC1A), sensor on PC0 (ADC0),
 * LED on PD7. With NODE_FAST the line is on PD1 (TXD), and PD4 (XCK) stays unconnected. With NODE_FOUR there are four
 * sensors, on PC0 to PC3, and four lines, on PD2 to PD5, and PB1 stays unconnected.
 *
 * Where sync pulses come on the data wire, PD7 (AIN1) is joined with PB1 (NODE_FOUR: PD2), behind the node's resistor, and the LED is
 * on PB0. The comparator's output rises when AIN1 falls below the bandgap, 1.0 to 1.2 V, and goes to the capture
 * unit in place of PB0.
 *
 * Timer1 counts cycles. It captures edges of the sync line and generates those of the analog line, so
 * neither contains interrupt latency; with NODE_FAST the USART generates these, and with NODE_FOUR the program, which waits
 * for their cycle. Fuses: crystal, no division by 8, brown-out at 2.7 V,
 * EEPROM kept when the chip is erased (low 0xFD, high 0xD1, extended 0xFD).
 */
#ifndef NODE_ATMEGA328P_H
#define NODE_ATMEGA328P_H

#include <avr/interrupt.h>
#include <avr/io.h>

#include "node_memory.h"

#define BOARD_TICKS_PER_US 8u
#define BOARD_MATCH_vect TIMER1_COMPA_vect
#define BOARD_SYNC_vect TIMER1_CAPT_vect

#ifdef NODE_FOUR
#define BOARD_ORDER 1024 /* four rows: 512 bytes of the 1 kB EEPROM, and of the 2 kB RAM */
#define BOARD_SENSORS 4
#define BOARD_READING_US 1050u
#define BOARD_MEASURING_US 1700u
#define BOARD_FIRST_LINE PD2
#define BOARD_LINES (0xFu << BOARD_FIRST_LINE)
#else
#define BOARD_ORDER 4096 /* 512 bytes of the 1 kB EEPROM, and of the 2 kB RAM */
#define BOARD_SENSORS 1
#define BOARD_READING_US 800u
#define BOARD_MEASURING_US 900u
#define BOARD_LINE PB1
#endif
#ifdef NODE_FAST
#define BOARD_NAME "node-atmega328p-fast"
#define BOARD_CHIP_NS 500u /* shortest that test_fast_node.py runs without a wrong edge */
#define BOARD_SCRAMBLED_CHIP_NS 1750u
#define BOARD_SPARSE_CHIP_NS 2000u
#define BOARD_LONGEST_CHIP_NS 16000u
#define BOARD_CHIP_STEP_NS 250u
#define BOARD_BITS_RESTART true
#define BOARD_RESTART_US 80u
#define BOARD_HEARS_OWN true
#define BOARD_HEARS_DATA false
#else
#ifdef NODE_FOUR
#define BOARD_NAME "node-atmega328p-four"
#define BOARD_CHIP_NS 43000u /* shortest that test_four_node.py runs without a wrong edge */
#define BOARD_SCRAMBLED_CHIP_NS 43000u
#define BOARD_SPARSE_CHIP_NS 0u
#else
#define BOARD_NAME "node-atmega328p"
#define BOARD_CHIP_NS 35000u /* shortest that test_node_image.py runs without a wrong edge */
#define BOARD_SCRAMBLED_CHIP_NS 35000u
#define BOARD_SPARSE_CHIP_NS 35000u
#endif
#define BOARD_LONGEST_CHIP_NS 1000000u
#define BOARD_CHIP_STEP_NS 1u
#define BOARD_BITS_RESTART false
#define BOARD_RESTART_US 96u
#define BOARD_HEARS_OWN true
#define BOARD_HEARS_DATA true
#endif

#define BOARD_LARGE true
#define BOARD_SYNC PB0
#define BOARD_LED PD7
#define BOARD_LED_PORT PORTD
#define BOARD_AIN1 PD7

extern volatile uint16_t board_overflows;

/* Time of a recent count of the timer; interrupts are off. */
static BOARD_INLINE uint32_t board_time(uint16_t count)
{
    uint16_t overflows = board_overflows;

    if (TIFR1 & _BV(TOV1) && count < 0x8000u)
        overflows++; /* its interrupt is pending */
    return (uint32_t)overflows << 16 | count;
}

/* Counts an overflow of the timer in place of its interrupt, where interrupts are off for long. */
static BOARD_INLINE void board_note_overflow(void)
{
    if (TIFR1 & _BV(TOV1)) {
        TIFR1 = _BV(TOV1);
        board_overflows++;
    }
}

static BOARD_INLINE void board_level(bool high)
{
    TCCR1A = high ? _BV(COM1A1) | _BV(COM1A0) : _BV(COM1A1);
}

static BOARD_INLINE bool board_match(bool high, uint16_t at)
{
    board_level(high);
    OCR1A = at - 1u; /* the latch changes with the tick after the match */
    return (int16_t)(at - 1u - TCNT1) > 0;
}

static BOARD_INLINE bool board_match_is_last(void)
{
    return true;
}

static BOARD_INLINE bool board_match_goes_on(void)
{
    return true;
}

static BOARD_INLINE bool board_match_level(void)
{
    return TCCR1A & _BV(COM1A0);
}

static BOARD_INLINE void board_latch(bool high)
{
    board_level(high);
    TCCR1C = _BV(FOC1A);
}

static BOARD_INLINE void board_match_past(uint16_t at)
{
    OCR1A = at - 16u;
}

static BOARD_INLINE void board_matches_on(void)
{
    TIFR1 = _BV(OCF1A);
    TIMSK1 |= _BV(OCIE1A);
}

static BOARD_INLINE void board_matches_off(void)
{
    TIMSK1 &= (uint8_t)~_BV(OCIE1A);
}

/* In GPIOR0, where an instruction asks for it: sync pulses come on the data wire; there is an LED. */
#define BOARD_ON_DATA _BV(0)
#define BOARD_HAS_LED _BV(1)

static BOARD_INLINE bool board_has_led(void)
{
    return !BOARD_HEARS_DATA || GPIOR0 & BOARD_HAS_LED;
}

static BOARD_INLINE bool board_on_data(void)
{
    return BOARD_HEARS_DATA && GPIOR0 & BOARD_ON_DATA;
}

/* Whether a pulse is present. AIN1's digital input is off: its comparator is asked. */
static BOARD_INLINE bool board_sync_level(void)
{
    return board_on_data() ? ACSR & _BV(ACO) : PINB & _BV(BOARD_SYNC);
}

/* TCCR1B has the timer count cycles, and a capture take a level that lasts for 4 of them, so that a spike
 * in a pulse does not end it. */
#define BOARD_COUNTING (_BV(ICNC1) | _BV(CS10))
#define BOARD_CANCELLER_CYCLES 4u
/* Cycles by which the comparator's edges on the data wire are late: 0.3 to 1.5 µs where a pulse begins, up to 3.5
 * more where it ends, by SPICE and the data sheet. Chosen: the middle. */
#define BOARD_BEGIN_CYCLES 8u
#define BOARD_END_CYCLES 16u

static BOARD_INLINE uint8_t board_sync_delay(bool begins)
{
    if (!board_on_data())
        return BOARD_CANCELLER_CYCLES;
    return begins ? BOARD_CANCELLER_CYCLES + BOARD_BEGIN_CYCLES : BOARD_CANCELLER_CYCLES + BOARD_END_CYCLES;
}

static BOARD_INLINE void board_sync_on(void)
{
    TCCR1B = BOARD_COUNTING | _BV(ICES1); /* the next rising edge first */
    TIFR1 = _BV(ICF1);
    TIMSK1 |= _BV(ICIE1);
}

static BOARD_INLINE void board_sync_off(void)
{
    TIMSK1 &= (uint8_t)~_BV(ICIE1);
}

/* Ticks: 7/8 of the shortest pulse, so that a node's clock may be 1/8 off. A pulse that is over at a look
 * before this was a glitch; at a later one, which another interrupt delayed, it may have been a restart's. An
 * undelayed look, the first thing after registers are saved, is some 80 ticks after the rising edge. */
#define BOARD_LATE_LOOK (TP_SYNC_UNIT_US * BOARD_TICKS_PER_US * 7u / 8u)

static BOARD_INLINE bool board_sync_edge(uint32_t *when)
{
    bool low = !board_sync_level();
    uint16_t look = TCNT1, edge = ICR1;
    bool rising = TCCR1B & _BV(ICES1);

    if (!rising || !low) { /* listens for the other edge; else still for a rising one */
        TCCR1B = rising ? BOARD_COUNTING : BOARD_COUNTING | _BV(ICES1);
        TIFR1 = _BV(ICF1); /* changing the edge may look like one */
    }
    *when = board_time(edge) - board_sync_delay(rising);
    if (!rising)
        return false;
    if (low)
        return (uint16_t)(look - (uint16_t)*when) >= BOARD_LATE_LOOK;
    if (!board_sync_level() && !(TIFR1 & _BV(ICF1)))
        TCCR1B = BOARD_COUNTING | _BV(ICES1); /* it fell just before that was listened for */
    return true;
}

static BOARD_INLINE bool board_sync_fell(uint16_t rise, uint16_t *length)
{
    if (!(TIFR1 & _BV(ICF1)))
        return false;
    *length = ICR1 - board_sync_delay(false) - rise;
    return true;
}

static BOARD_INLINE bool board_sync_over(uint16_t rise, bool short_is_due, uint16_t *length)
{
    if (!(TCCR1B & _BV(ICES1)))
        return board_sync_fell(rise, length);
    (void)short_is_due; /* else it may be a digit of a turn */
    *length = TP_SYNC_UNIT_US * BOARD_TICKS_PER_US;
    return true;
}

static BOARD_INLINE int16_t board_ticks_until(uint16_t at)
{
    return (int16_t)(at - TCNT1);
}

static BOARD_INLINE uint16_t board_ticks_since(uint16_t then)
{
    return TCNT1 - then;
}

#define BOARD_SPIN_TICKS 40
#define BOARD_SPIN_LEAST 30 /* … without board_spin_most: 15, and to compare */
/* Waits until BOARD_SPIN_LAST has its last cycles left. */
static BOARD_INLINE void board_spin_most(uint16_t at)
{
    while (board_ticks_until(at) > 4 * BOARD_SPIN_TICKS)
        ;
}

/* Instructions that wait for the rest, with the low byte of the time in [left], which is used up. Read at cycle
 * t, the count leaves at - t cycles, of which these take 13 and the one that follows 2. */
#define BOARD_SPIN_LAST                                                                            \
    "lds __tmp_reg__, %[count] \n\t"                                                               \
    "sub %[left], __tmp_reg__  \n\t"                                                               \
    "subi %[left], 15          \n\t"                                                               \
    "1: subi %[left], 4        \n\t" /* 4 cycles each, 3 the last time */                           \
    "nop                       \n\t"                                                               \
    "brcc 1b                   \n\t"                                                               \
    "sbrc %[left], 0           \n\t" /* 2 cycles, or 3 */                                           \
    "rjmp 2f                   \n\t"                                                               \
    "2: sbrc %[left], 1        \n\t" /* and for twice as much two of them */                        \
    "rjmp 3f                   \n\t"                                                               \
    "3: sbrc %[left], 1        \n\t"                                                               \
    "rjmp 4f                   \n\t"                                                               \
    "4:                        \n\t"

static BOARD_INLINE void board_spin(uint16_t at)
{
    uint8_t left = (uint8_t)at;

    board_spin_most(at);
    __asm__ volatile(BOARD_SPIN_LAST : [left] "+d"(left) : [count] "n"(_SFR_MEM_ADDR(TCNT1L)));
}

#endif
