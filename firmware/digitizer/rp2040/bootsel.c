// SPDX-License-Identifier: Apache-2.0

/* Restarts the board as a USB drive for a new image, as its BOOTSEL button does at power-up: a board on
 * an arm is out of a finger's reach.
 */
#include "registers.h"
#include "rp2040.h"

#define LATE_US 100000u /* chosen: the answer to the command leaves before */

typedef void *look_up_function(uint16_t *table, uint32_t code);
typedef void reset_to_usb_function(uint32_t activity_pins, uint32_t disabled_interfaces);

static volatile bool asked;
static uint64_t asked_us;

void bootsel_ask(void)
{
    if (!asked)
        asked_us = time_us();
    asked = true;
}

void bootsel_when_asked(void)
{
    if (!asked || time_us() - asked_us < LATE_US)
        return;
    interrupts_off();
    look_up_function *look_up = (look_up_function *)(uintptr_t)rom_lookup;
    uint16_t *table = (uint16_t *)(uintptr_t)rom_functions;
    reset_to_usb_function *reset_to_usb = (reset_to_usb_function *)look_up(table, 'U' | 'B' << 8);
    reset_to_usb(1u << PIN_LED, 0);
}
