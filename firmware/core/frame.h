// SPDX-License-Identifier: Apache-2.0

/* The shape of a frame: how many chips it has and where they lie. See docs/signal-model.md. */
#ifndef TACTILE_FRAME_H
#define TACTILE_FRAME_H

#include <stdint.h>

/* Bits of a word on the line: with its parity. */
static inline uint8_t frame_line_bits(uint8_t bits, uint8_t parity)
{
    return (uint8_t)(bits + (parity != 0));
}

/* Where coded chip `chip` lies, in chips after the frame's start. */
static inline uint32_t frame_place(uint32_t chip, uint16_t resync_chips, uint8_t guard_chips)
{
    return resync_chips ? chip + chip / resync_chips * guard_chips : chip;
}

/* Chips from a frame's start to its end, guards included; `chips` ≥ 1 of them are coded. */
static inline uint32_t frame_span(uint32_t chips, uint16_t resync_chips, uint8_t guard_chips)
{
    return frame_place(chips - 1, resync_chips, guard_chips) + 1;
}

#endif
