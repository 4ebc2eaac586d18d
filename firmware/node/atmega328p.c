// SPDX-License-Identifier: Apache-2.0

#include "node_board.h"
#include "doze.h"

#include <avr/pgmspace.h>
#include <avr/power.h>
#include <avr/wdt.h>
#include <util/atomic.h>
#include <util/delay.h>

/* Tells programs apart for those who join them with memories. Behind the vectors, as the linker drops what
 * nobody reads everywhere else. */
__attribute__((used, section(".vectors"))) static const char name[] = BOARD_NAME;

/* On port C, the first of them at ADC0. */
#define SENSORS ((1u << BOARD_SENSORS) - 1u)

volatile uint16_t board_overflows;

ISR(TIMER1_OVF_vect)
{
    board_overflows++;
}

static volatile bool rang; /* the alarm */

ISR(TIMER1_COMPB_vect)
{
    rang = true;
}

void board_init(void)
{
    /* after a watchdog reset the watchdog runs on with its shortest period */
    MCUSR = 0;
    wdt_enable(WDTO_250MS);
    clock_prescale_set(board_flash_byte(offsetof(struct tp_node_table, crystal_mhz)) == 16 ? clock_div_2
                                                                                           : clock_div_1);

    PRR = _BV(PRTWI) | _BV(PRTIM2) | _BV(PRTIM0) | _BV(PRSPI);
    DIDR0 = SENSORS;
    /* unconnected pins are pulled up, so that they don't float */
#ifdef NODE_FOUR
    PORTB = (uint8_t)~_BV(BOARD_SYNC);
#else
    PORTB = (uint8_t)~(_BV(BOARD_LINE) | _BV(BOARD_SYNC));
#endif
    PORTC = (uint8_t)~SENSORS;
#ifdef NODE_FAST
    PORTD = (uint8_t)~(_BV(BOARD_LED) | _BV(PD1) | _BV(PD4)); /* the line, and the chips' clock */
    DDRD = _BV(BOARD_LED) | _BV(PD4);
    ACSR = _BV(ACD);
#else
#ifdef NODE_FOUR
    PORTD = (uint8_t)~(_BV(BOARD_LED) | BOARD_LINES);
#else
    PORTD = (uint8_t)~_BV(BOARD_LED);
#endif
    PRR |= _BV(PRUSART0);
#endif

    TCCR1B = BOARD_COUNTING;
    TIMSK1 = _BV(TOIE1);
    ADMUX = _BV(REFS0); /* AVcc is the reference, channel 0 */
    /* sleep mode stays idle, the reset value: timer and capture run on */
}

#ifndef NODE_FAST
/* A pin that is joined with the line returns to half the supply once it is released; one with the LED, or with
 * nothing, does not. */
bool board_is_joined(void)
{
    ACSR = _BV(ACBG);
    DDRD |= _BV(BOARD_AIN1);
    _delay_us(1);
    DDRD &= (uint8_t)~_BV(BOARD_AIN1);
    _delay_us(100); /* the bandgap starts in 70 µs */
    return !(ACSR & _BV(ACO));
}

void board_listen(bool on_data, bool has_led)
{
    GPIOR0 = (uint8_t)((on_data ? BOARD_ON_DATA : 0) | (has_led ? BOARD_HAS_LED : 0));
    if (!on_data) {
        ACSR = _BV(ACD);
        if (has_led)
            DDRD |= _BV(BOARD_LED);
        return;
    }
    DIDR1 = _BV(AIN1D); /* half the supply would have a digital input draw current */
    ACSR = _BV(ACBG) | _BV(ACIC);
    if (has_led)
        DDRB |= _BV(BOARD_SYNC);
}
#endif

uint32_t board_now(void)
{
    uint32_t now;

    ATOMIC_BLOCK (ATOMIC_RESTORESTATE)
        now = board_time(TCNT1);
    return now;
}

uint8_t board_flash_byte(uint16_t address)
{
    return pgm_read_byte(TP_NODE_FLASH + address);
}

void board_sleep(uint32_t when, const volatile uint8_t *event)
{
    rang = false;
    ATOMIC_BLOCK (ATOMIC_RESTORESTATE) {
        OCR1B = (uint16_t)when; /* more than 65,536 ticks ahead it rings early, which is allowed */
        TIFR1 = _BV(OCF1B);
        TIMSK1 |= _BV(OCIE1B);
    }
    if ((int32_t)(when - board_now()) <= 0)
        rang = true; /* too late for the alarm */
    /* other interrupts wake the CPU too, once per chip: this loop keeps their cost low */
    for (;;) {
        cli();
        if (rang || *event)
            break;
        doze();
    }
    TIMSK1 &= (uint8_t)~_BV(OCIE1B);
    sei();
}
