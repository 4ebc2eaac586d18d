// SPDX-License-Identifier: Apache-2.0

/* What the emulator cannot follow, or no node should do: a deep sleep, a read beyond the EEPROM. */
#include <avr/eeprom.h>

#include "specimen.h"

int main(void)
{
    GPIOR0 = eeprom_read_byte((const uint8_t *)E2END + 1);
    sleep_cpu(); /* not enabled: nothing */
    set_sleep_mode(SLEEP_MODE_PWR_DOWN);
    for (;;)
        sleep_mode();
}
