// SPDX-License-Identifier: Apache-2.0

/* The digitizer's settings: what CONFIGURE asks for, in samples and ticks. */
#ifndef TACTILE_SETUP_H
#define TACTILE_SETUP_H

#include <stdbool.h>
#include <stdint.h>

#include "board.h"
#include "stride.h"
#include "tactile_protocol.h"

#define SETUP_LEAST_MEAN 4    /* of chips too short for that a single sample is taken. Chosen */
#define SETUP_MAX_MEAN 4096   /* samples averaged per chip at most. Chosen; sum · 8 < 2²⁷ */
#define SETUP_MEAN_SHIFT 3    /* a mean is sent in 1/8 count: 12 bits and 3 more fit an int16 */
#define SETUP_MEAN_SCALE (1 << SETUP_MEAN_SHIFT)
#define DG_FIRST_MARK_US 1000 /* least time from a stream's start to its first frame, µs. Chosen */

struct setup {
    struct tp_configure asked; /* as in force */
    bool marked;               /* sync pulses mark the frames */
    uint32_t ticks_per_us;
    uint32_t ticks_per_sample;
    uint64_t sample_rate_uhz; /* of the words sent */
    uint32_t gap_samples;     /* at most in a packet of the gap */
    uint32_t quiet_counts;    /* largest difference within a QUIET; 0: never send QUIET */

    uint64_t first_mark;    /* tick of the first frame, a multiple of ticks_per_sample */
    uint64_t period_ticks;  /* frame period */
    uint64_t frame_samples; /* raw samples in a frame and its tail */
    uint32_t chips;         /* coded chips in a frame */
    bool samples_are_chips; /* integrated, from one sample each */
    uint32_t early_ticks;   /* pulses are so much earlier than samples need; see setup.c */
    struct stride period, chip, guard;
};

/* In force before any CONFIGURE: the skin of config/skin.yaml. */
extern const struct tp_configure setup_default;

/* Derives the settings for `asked`, whose fields are all within their ranges. Returns false and leaves
 * setup unchanged if this board cannot provide them. */
bool setup_make(struct setup *setup, const struct dg_board *board,
                const struct tp_configure *asked);

/* Ticks by which a frame period may differ from the one before: nodes take more for a disturbance. */
#define SETUP_MOVED_SHIFT 9
static inline uint64_t setup_most_moved(const struct setup *setup)
{
    return setup->period_ticks >> SETUP_MOVED_SHIFT;
}

/* Whether there is time before a frame for the pulses of its turn. */
bool setup_has_turns(const struct setup *setup);
/* … and for that of a turn in which all are asked to speak. */
bool setup_can_ask(const struct setup *setup);

/* Whether there is time after a frame's last pulse for those of a number. */
bool setup_has_numbers(const struct setup *setup);

/* Time from a frame's mark to the start of chip `chip`, in thousandths of a tick. */
uint64_t setup_chip_place(const struct setup *setup, uint32_t chip);

#endif
