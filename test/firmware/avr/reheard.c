// SPDX-License-Identifier: Apache-2.0

/* Copies the sync line to its output until the watchdog (16 ms) resets it, again and again. */
#include <avr/wdt.h>

#include "specimen.h"

int main(void)
{
    wdt_enable(WDTO_15MS);
    DDRB = _BV(OUT);
    for (;;) {
        if (PINB & _BV(SYNC))
            PORTB |= _BV(OUT);
        else
            PORTB &= (uint8_t)~_BV(OUT);
    }
}
