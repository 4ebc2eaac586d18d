// SPDX-License-Identifier: Apache-2.0

/* At every sync pulse shows the next byte of its EEPROM. */
#include <avr/eeprom.h>

#include "specimen.h"

int main(void)
{
    DDRB = _BV(OUT);
    for (uint8_t *byte = 0;; byte++) {
        wait_for_sync();
        show(eeprom_read_byte(byte));
    }
}
