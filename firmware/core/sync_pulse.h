// SPDX-License-Identifier: Apache-2.0

/* Decodes the length of a pulse on the sync line, in units of TP_SYNC_UNIT_US. */
#ifndef TACTILE_SYNC_PULSE_H
#define TACTILE_SYNC_PULSE_H

#include <stdint.h>

#include "tactile_protocol.h"

#define SYNC_PULSE_GLITCH 0u

/* Rounds a length to TP_SYNC_RESTART or TP_SYNC_FRAME units, so clocks may be 20 % off; anything shorter or longer is SYNC_PULSE_GLITCH. unit_ticks: a constant that divides 256, so
 * that an AVR divides by taking the upper byte. */
static inline uint8_t sync_pulse_units(uint32_t ticks, uint16_t unit_ticks)
{
    if (ticks >= TP_SYNC_FRAME * unit_ticks + unit_ticks / 2u)
        return SYNC_PULSE_GLITCH;
    return (uint8_t)((uint16_t)((uint16_t)(ticks + unit_ticks / 2u) * (256u / unit_ticks)) >> 8);
}

#endif
