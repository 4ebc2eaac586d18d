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

/* Released some 200 cycles after Timer1 starts; a match sets the latch, high until then, low: when,
 * byte 0 of the EEPROM says in cycles. */
#include <avr/eeprom.h>

#include "specimen.h"

int main(void)
{
    OCR1A = (uint16_t)(180 + eeprom_read_byte(0));
    TCCR1A = _BV(COM1A1) | _BV(COM1A0);
    TCCR1C = _BV(FOC1A);
    TCCR1A = _BV(COM1A1);
    DDRB = _BV(OUT);
    TCCR1B = _BV(CS10);
    _delay_loop_1(64);
    DDRB = 0;
    for (;;)
        ;
}
