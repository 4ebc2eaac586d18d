// SPDX-License-Identifier: Apache-2.0

/* Drives its output as the latch is, forces that high, takes no care of the watchdog (16 ms), and
 * lights the LED after a reset by it. */
#include <avr/wdt.h>

#include "specimen.h"

int main(void)
{
    if (MCUSR & _BV(WDRF)) {
        LED_DDR |= _BV(LED);
        LED_PORT |= _BV(LED);
    }
    wdt_enable(WDTO_15MS);
    OCR1A = 255; /* no match in the meantime */
    MODE(SET);
    DDRB |= _BV(OUT);
    FORCE();
    for (;;)
        ;
}
