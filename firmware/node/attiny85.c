// SPDX-License-Identifier: Apache-2.0

#include "node_board.h"
#include "doze.h"

#include <avr/power.h>
#include <avr/wdt.h>
#include <util/atomic.h>

uint32_t board_ticks;
uint16_t board_match_here, board_match_at;
bool board_match_high;

/* Longest sleep, ticks: half a turn of Timer0, since board_now must see every turn. */
#define NAP_TICKS 0x4000

static volatile bool rang; /* the alarm */

ISR(TIMER0_COMPA_vect)
{
    rang = true;
}

/* Reads time and level in its first instructions, then jumps to the interrupt of talk.c. */
#ifdef NODE_DATA
ISR(ANA_COMP_vect, ISR_NAKED)
#else
ISR(INT0_vect, ISR_NAKED)
#endif
{
    __asm__ volatile("push r24                \n\t"
                     "in r24, %[count]        \n\t"
                     "out %[time], r24        \n\t"
                     "in r24, %[pins]         \n\t"
                     "out %[level], r24       \n\t"
                     "pop r24                 \n\t"
                     "rjmp __vector_sync_edge \n\t" ::[count] "I"(_SFR_IO_ADDR(TCNT1)),
                     [time] "I"(_SFR_IO_ADDR(GPIOR0)), [pins] "I"(_SFR_IO_ADDR(BOARD_LEVEL)),
                     [level] "I"(_SFR_IO_ADDR(GPIOR1)));
}

void board_init(void)
{
    /* after a watchdog reset the watchdog runs on with its shortest period */
    MCUSR = 0;
    wdt_enable(WDTO_250MS);
    clock_prescale_set(clock_div_1);

    PRR = _BV(PRUSI);
    DIDR0 = _BV(ADC3D);
#ifdef NODE_DATA
    ACSR = _BV(ACBG);
    PORTB = _BV(PB0) | _BV(PB2); /* unconnected, so pulled up */
#else
    ACSR = _BV(ACD);
    PORTB = _BV(PB0); /* unconnected, so pulled up */
#endif
    DDRB = _BV(BOARD_LED);

    MCUCR = _BV(ISC00); /* INT0 at any edge; sleep is idle */
    GTCCR = _BV(PSR0); /* the prescaler has been counting since power-up */
    TCCR0B = _BV(CS02);
    TCCR1 = BOARD_COUNTING;
    ADMUX = _BV(MUX1) | _BV(MUX0); /* Vcc is the reference, channel 3 */
}

uint32_t board_now(void)
{
    uint32_t now;

    ATOMIC_BLOCK (ATOMIC_RESTORESTATE) {
        if (TIFR & _BV(TOV0)) {
            TIFR = _BV(TOV0);
            board_ticks += 0x8000u;
        }
        now = board_time(TCNT1);
    }
    return now;
}

void board_sleep(uint32_t when, const volatile uint8_t *event)
{
    uint32_t now = board_now();

    /* bounded from now on, so that the alarm does not ring near the pulse that the node waits for */
    if ((int32_t)(when - now) > NAP_TICKS)
        when = now + NAP_TICKS;
    rang = false;
    ATOMIC_BLOCK (ATOMIC_RESTORESTATE) {
        OCR0A = (uint8_t)(when >> 7); /* rings up to 32 µs late: one count of Timer0 */
        TIFR = _BV(OCF0A);
        TIMSK |= _BV(OCIE0A);
    }
    if ((int32_t)(when - board_now()) <= 128)
        rang = true; /* Timer0 may already have matched: too late for the alarm */
    /* other interrupts wake the CPU too, once per chip: this loop keeps their cost low */
    for (;;) {
        cli();
        if (rang || *event)
            break;
        doze();
    }
    TIMSK &= (uint8_t)~_BV(OCIE0A);
    sei();
}
