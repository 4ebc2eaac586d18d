// SPDX-License-Identifier: Apache-2.0

/* What a CONFIGURE means by docs/protocol.md, in exact numbers of 128 bits. */
#ifndef FUZZ_SETTINGS_H
#define FUZZ_SETTINGS_H

#include <stdbool.h>
#include <stdint.h>

#include "board.h"
#include "tactile_protocol.h"

__extension__ typedef __int128 wide;

struct settings {
    struct tp_configure asked; /* as it holds: HEAR is DRIVE */
    bool marked;
    uint32_t ticks_per_us, ticks_per_sample;
    uint32_t chips;      /* coded ones in a frame */
    wide first_mark;     /* thousandths of a tick, as all that follows */
    wide period, chip;
    uint32_t quiet_counts;
};

/* What the digitizer has to answer. settings: what holds then, if that is OK. */
enum tp_result settings_of(struct settings *settings, const struct dg_board *board,
                           const struct tp_configure *asked);

/* When a chip of a frame begins, after its mark. */
wide settings_chip(const struct settings *settings, uint32_t chip);

/* Number of the first sample that is taken at or after a time. */
uint64_t settings_sample(const struct settings *settings, wide time);

/* First sample of frame number `frame`. */
uint64_t settings_mark(const struct settings *settings, uint64_t frame);

/* A time in µs, to the nearest. */
uint64_t settings_us(const struct settings *settings, wide time);

#endif
