// SPDX-License-Identifier: Apache-2.0

/* Whose turn a frame is, from the pulses before it: see docs/protocol.md, groups. */
#ifndef TACTILE_TURN_H
#define TACTILE_TURN_H

#include <stdbool.h>
#include <stdint.h>

#include "tactile_protocol.h"

/* The bit of the turn for which a pulse stands that begins so many ticks before the frame's; 0: for none.
 * unit_ticks: of TP_SYNC_UNIT_US, a power of two, so that an AVR does not divide. */
static inline uint8_t turn_digit(uint32_t ticks, uint16_t unit_ticks)
{
    uint16_t digit_ticks = TP_SYNC_DIGIT * unit_ticks, slack = 2u * unit_ticks;

    if (ticks > (uint32_t)(TP_TURN_MOST_LOG2 + 1u) * digit_ticks + slack)
        return 0;
    uint16_t late = (uint16_t)ticks + slack, place = late / digit_ticks;
    if (late % digit_ticks > 2u * slack)
        return 0;
    return (uint8_t)(1u << place >> 1);
}

/* Whether it is the turn of another group than this node's. */
static inline bool turn_is_others(uint8_t turn, uint16_t node)
{
    uint8_t below = turn | turn >> 1; /* becomes the number of groups less 1 */

    below |= below >> 2;
    below |= below >> 4;
    return (turn ^ (uint8_t)node) & below >> 1;
}

#endif
