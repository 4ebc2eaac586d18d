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

/* What both microcontrollers do alike: the converter, the LED, the EEPROM. */
#include "board.h"
#include "doze.h"

#include <avr/eeprom.h>

EMPTY_INTERRUPT(ADC_vect)

/* One conversion, asleep: 8 MHz / 64 = 125 kHz. */
static uint16_t convert(void)
{
    ADCSRA = _BV(ADEN) | _BV(ADSC) | _BV(ADIE) | _BV(ADPS2) | _BV(ADPS1);
    for (;;) {
        cli();
        if (!(ADCSRA & _BV(ADSC)))
            break;
        doze();
    }
    sei();
    return ADC;
}

uint16_t board_measure(void)
{
    uint16_t reading;

    convert(); /* the first one after the converter was off is not good */
    reading = convert();
    ADCSRA = 0;
    return reading;
}

void board_led(bool on)
{
    if (on)
        BOARD_LED_PORT |= _BV(BOARD_LED);
    else
        BOARD_LED_PORT &= (uint8_t)~_BV(BOARD_LED);
}

uint8_t board_memory_byte(uint16_t address)
{
    return eeprom_read_byte((const uint8_t *)address);
}
