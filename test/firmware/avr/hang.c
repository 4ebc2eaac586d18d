// Copyright 2026 tactile_cdma maintainers
//
// Licensed under the Apache License, Version 2.0 (the "License");
// you may not use this file except in compliance with the License.
// You may obtain a copy of the License at
//
//     http://www.apache.org/licenses/LICENSE-2.0
//
// Unless required by applicable law or agreed to in writing, software
// distributed under the License is distributed on an "AS IS" BASIS,
// WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
// See the License for the specific language governing permissions and
// limitations under the License.

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
