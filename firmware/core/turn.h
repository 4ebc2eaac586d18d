// SPDX-License-Identifier: Apache-2.0

/* Whose turn a frame is, and what number it announces, from the pulses before it: see docs/protocol.md,
 * groups and numbers. */
#ifndef TACTILE_TURN_H
#define TACTILE_TURN_H

#include <stdbool.h>
#include <stdint.h>

#include "tactile_protocol.h"

#define TURN_DIGITS 16u
#define TURN_OF_GROUPS ((2u << TP_TURN_MOST_LOG2) - 1u) /* the digits of a turn without a number's */

/* The bit of the turn for which a pulse stands that begins so many ticks before the frame's; 0: for none.
 * digit_ticks: of TP_SYNC_DIGIT. An AVR does not divide. */
static inline uint16_t turn_digit(uint32_t ticks, uint16_t digit_ticks)
{
    uint16_t slack = digit_ticks / 4u, bit = 1;

    if (ticks > (uint32_t)TURN_DIGITS * digit_ticks + slack)
        return 0;
    uint16_t late = (uint16_t)ticks + slack;
    for (; late >= 2u * digit_ticks; late -= digit_ticks)
        bit = (uint16_t)(bit << 1);
    return late >= digit_ticks && late <= digit_ticks + 2u * slack ? bit : 0;
}

/* Whether a frame announces a number. */
static inline bool turn_has_number(uint16_t turn)
{
    return (turn & TURN_OF_GROUPS) == TP_TURN_NUMBERS;
}

/* The number, and above its bits whether it is to be forgotten: then it is no node's. */
static inline uint16_t turn_number(uint16_t turn)
{
    return turn >> TP_TURN_NUMBER_SHIFT;
}

/* A turn as flags of the packet that begins its frame. */
static inline uint8_t turn_flags(uint8_t turn)
{
    uint8_t flags = (uint8_t)((turn & TURN_OF_GROUPS) << TP_TURN_SHIFT);

    return turn & TP_TURN_ASKED ? flags | TP_FLAG_ASKED : flags;
}

/* The number of groups less 1. */
static inline uint8_t turn_mask(uint16_t digits)
{
    uint8_t turn = digits & TURN_OF_GROUPS;
    uint8_t below = turn | turn >> 1;

    below |= below >> 2;
    below |= below >> 4;
    return below >> 1;
}

/* Whether it is the turn of another group than this node's. */
static inline bool turn_is_others(uint16_t digits, uint16_t node)
{
    return ((uint8_t)digits ^ (uint8_t)node) & turn_mask(digits);
}

#endif
