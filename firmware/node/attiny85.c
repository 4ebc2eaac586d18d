// SPDX-License-Identifier: Apache-2.0

#include "board.h"
#include "doze.h"

#include <avr/power.h>
#include <avr/wdt.h>
#include <util/atomic.h>

uint32_t board_ticks;
uint16_t board_match_here, board_match_at;
bool board_match_high;

/* Longest sleep, in ticks: half a turn of Timer0, of which board_now must miss none. */
#define NAP_TICKS 0x4000

static volatile bool rang; /* the alarm */

ISR(TIMER0_COMPA_vect)
{
    rang = true;
}

/* Notes time and level before anything else; talk.c goes on from there. */
ISR(INT0_vect, ISR_NAKED)
{
    __asm__ volatile("push r24                \n\t"
                     "in r24, %[count]        \n\t"
                     "out %[time], r24        \n\t"
                     "in r24, %[pins]         \n\t"
                     "out %[level], r24       \n\t"
                     "pop r24                 \n\t"
                     "rjmp __vector_sync_edge \n\t" ::[count] "I"(_SFR_IO_ADDR(TCNT1)),
                     [time] "I"(_SFR_IO_ADDR(GPIOR0)), [pins] "I"(_SFR_IO_ADDR(PINB)),
                     [level] "I"(_SFR_IO_ADDR(GPIOR1)));
}

void board_init(void)
{
    /* after its own reset the watchdog goes on, in its shortest period */
    MCUSR = 0;
    wdt_enable(WDTO_250MS);
    clock_prescale_set(clock_div_1);

    PRR = _BV(PRUSI);
    ACSR = _BV(ACD);
    DIDR0 = _BV(ADC3D);
    PORTB = _BV(PB0); /* leads nowhere, so it is pulled up */
    DDRB = _BV(BOARD_LED);

    MCUCR = _BV(ISC00); /* INT0 at any edge; sleep is idle */
    GTCCR = _BV(PSR0); /* it has been counting since power-up */
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

    /* so what wakes it isn't near a pulse that it goes to sleep for */
    if ((int32_t)(when - now) > NAP_TICKS)
        when = now + NAP_TICKS;
    rang = false;
    ATOMIC_BLOCK (ATOMIC_RESTORESTATE) {
        OCR0A = (uint8_t)(when >> 7); /* rings up to 32 µs late */
        TIFR = _BV(OCF0A);
        TIMSK |= _BV(OCIE0A);
    }
    if ((int32_t)(when - board_now()) <= 128)
        rang = true; /* Timer0 may be there already: too late for the alarm */
    /* what else wakes us, every chip for one, must not cost more than this */
    for (;;) {
        cli();
        if (rang || *event)
            break;
        doze();
    }
    TIMSK &= (uint8_t)~_BV(OCIE0A);
    sei();
}
