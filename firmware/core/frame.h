// SPDX-License-Identifier: Apache-2.0

/* Number and position of the chips in a frame. See docs/signal-model.md. */
#ifndef TACTILE_FRAME_H
#define TACTILE_FRAME_H

#include <stdint.h>

/* Bits of a word on the line, including parity. */
static inline uint8_t frame_line_bits(uint8_t bits, uint8_t parity)
{
    return (uint8_t)(bits + (parity != 0));
}

/* The bits of a word on the line, the first in bit 15: a code and, if asked for, its parity. */
static inline uint16_t frame_word(uint16_t code, uint8_t bits, uint8_t parity)
{
    uint16_t word = (uint16_t)(code << (16u - bits));
    uint8_t folded = (uint8_t)(word ^ word >> 8);

    if (!parity)
        return word;
    folded ^= folded >> 4;
    folded ^= folded >> 2;
    folded ^= folded >> 1;
    return word | (uint16_t)((folded & 1u) << (15u - bits));
}

/* Chips that fill up the first octet of a row, whose own chips end with an octet. */
static inline uint8_t frame_unused(uint16_t order)
{
    return (uint8_t)(-order & 7);
}

/* Position of coded chip `chip`, in chips from the frame's start. */
static inline uint32_t frame_place(uint32_t chip, uint16_t resync_chips, uint8_t guard_chips)
{
    return resync_chips ? chip + chip / resync_chips * guard_chips : chip;
}

/* Duration of a frame with `chips` ≥ 1 coded chips, in chips, including guards. */
static inline uint32_t frame_span(uint32_t chips, uint16_t resync_chips, uint8_t guard_chips)
{
    return frame_place(chips - 1, resync_chips, guard_chips) + 1;
}

#endif
