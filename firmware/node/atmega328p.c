// SPDX-License-Identifier: Apache-2.0

#include "node_board.h"
#include "doze.h"

#include <avr/pgmspace.h>
#include <avr/power.h>
#include <avr/wdt.h>
#include <util/atomic.h>

/* Tells programs apart for those who join them with memories. Behind the vectors, as the linker drops what
 * nobody reads everywhere else. */
__attribute__((used, section(".vectors"))) static const char name[] = BOARD_NAME;

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
    ACSR = _BV(ACD);
    DIDR0 = _BV(ADC0D);
    /* unconnected pins are pulled up, so that they don't float */
    PORTB = (uint8_t)~(_BV(BOARD_LINE) | _BV(BOARD_SYNC));
    PORTC = (uint8_t)~_BV(PC0);
#ifdef NODE_FAST
    PORTD = (uint8_t)~(_BV(BOARD_LED) | _BV(PD1) | _BV(PD4)); /* the line, and the chips' clock */
    DDRD = _BV(BOARD_LED) | _BV(PD4);
#else
    PORTD = (uint8_t)~_BV(BOARD_LED);
    DDRD = _BV(BOARD_LED);
    PRR |= _BV(PRUSART0);
#endif

    TCCR1B = BOARD_COUNTING;
    TIMSK1 = _BV(TOIE1);
    ADMUX = _BV(REFS0); /* AVcc is the reference, channel 0 */
    /* sleep mode stays idle, the reset value: timer and capture run on */
}

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
