// SPDX-License-Identifier: Apache-2.0

/* Small programs whose timing is known, for the tests of the emulator: a node's pins. */
#ifndef SPECIMEN_H
#define SPECIMEN_H

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <util/delay_basic.h>

#define OUT 1 /* of port B */
#if defined(__AVR_ATtiny85__)
#define SYNC 2
#define SYNC_VECTOR INT0_vect
#define LED_DDR DDRB
#define LED_PORT PORTB
#define LED 4
#define SENSOR 3
#define TIMER1_MASK TIMSK
#define TIMER1_FLAGS TIFR
#define MODE(mode) (TCCR1 = (uint8_t)(_BV(CS11) | (mode) << COM1A0))
#define FORCE() (GTCCR = _BV(FOC1A))
#define STEP 200 /* of 2 cycles */
#else
#define SYNC 0
#define SYNC_VECTOR TIMER1_CAPT_vect
#define LED_DDR DDRD
#define LED_PORT PORTD
#define LED 7
#define SENSOR 0
#define TIMER1_MASK TIMSK1
#define TIMER1_FLAGS TIFR1
#define MODE(mode) (TCCR1A = (uint8_t)((mode) << COM1A0))
#define FORCE() (TCCR1C = _BV(FOC1A))
#define STEP 400
#endif
enum { NONE, TOGGLE, CLEAR, SET }; /* of output compare A */

/* Timer1 runs, and the sync line's next edge (ATmega: a rising one) interrupts. */
static inline void listen(void)
{
#if defined(__AVR_ATtiny85__)
    TCCR1 = _BV(CS11); /* CK/2 */
    MCUCR |= _BV(ISC00);
    GIMSK = _BV(INT0);
#else
    TCCR1B = _BV(CS10) | _BV(ICES1);
    TIMSK1 = _BV(ICIE1);
#endif
}

static inline void wait_for_sync(void)
{
    loop_until_bit_is_clear(PINB, SYNC);
    loop_until_bit_is_set(PINB, SYNC);
}

/* A pulse whose length grows by 4 cycles per one. */
static inline void show(uint16_t value)
{
    PORTB |= _BV(OUT);
    _delay_loop_2((uint16_t)(value + 1));
    PORTB &= (uint8_t)~_BV(OUT);
}

static inline void sleep_on(void)
{
    set_sleep_mode(SLEEP_MODE_IDLE);
    sei();
    for (;;)
        sleep_mode();
}

#endif
