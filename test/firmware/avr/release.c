// SPDX-License-Identifier: Apache-2.0

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
