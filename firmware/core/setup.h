// SPDX-License-Identifier: Apache-2.0

/* How a digitizer is set: what a CONFIGURE asks for, in samples and ticks. */
#ifndef TACTILE_SETUP_H
#define TACTILE_SETUP_H

#include <stdbool.h>
#include <stdint.h>

#include "board.h"
#include "stride.h"
#include "tactile_protocol.h"

#define SETUP_MAX_MEAN 4096      /* samples in the mean of a chip: bounds the load of slow chips … */
#define SETUP_MEAN_SCALE 8       /* … whose means are sent in eighths of a count */
#define DG_FIRST_MARK_US 1000    /* from a stream's start to its first frame, at least */

struct setup {
    struct tp_configure asked; /* as it holds */
    bool marked;               /* frames are */
    uint32_t ticks_per_us;
    uint32_t ticks_per_sample;
    uint64_t sample_rate_uhz; /* of words */
    uint32_t gap_samples;     /* in a packet that no frame's end cuts, at most */
    uint32_t quiet_counts;    /* largest difference in QUIET; 0: there are none */

    uint64_t first_mark;    /* tick of the first frame, a multiple of ticks_per_sample */
    uint64_t period_ticks;  /* from frame to frame */
    uint64_t frame_samples; /* in a frame and its tail, if raw */
    uint32_t chips;         /* coded ones in a frame */
    struct stride period, chip, guard;
};

/* Before any CONFIGURE: what the host's driver is set to unless told otherwise. */
extern const struct tp_configure setup_default;

/* What it takes to do what is asked for, every field of which is in its range. False, and setup
 * is as it was, where this board cannot do it. */
bool setup_make(struct setup *setup, const struct dg_board *board,
                const struct tp_configure *asked);

/* When chip `chip` of a frame begins, after the frame's mark, in thousandths of a tick. */
uint64_t setup_chip_place(const struct setup *setup, uint32_t chip);

#endif
