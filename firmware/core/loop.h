// SPDX-License-Identifier: Apache-2.0

/* The digitizer's main loop, for boards that supply struct dg_hardware: moves bytes and samples
 * between the board and the digitizer.
 *
 * Packets go to the link that last sent a good command. Before the first command they go to the
 * first link that is ready. Where that link's host no longer listens, they are discarded, so that the next
 * one gets nothing stale; a stream that was commanded over it ends.
 */
#ifndef TACTILE_LOOP_H
#define TACTILE_LOOP_H

#include "digitizer.h"

struct dg_loop {
    struct dg *dg;
    const struct dg_hardware *hardware;
    const struct dg_link *commander; /* sent the last good command; NULL: none yet */
    const struct dg_link *heard;     /* whose bytes came last */
    const struct dg_link *carrier;   /* sends … */
    size_t in_flight;                /* … this many bytes of the output … */
    uint64_t since_us;               /* … since then */
};

/* After dg_init, which gets its time from the same clock as hardware->time_us. */
void dg_loop_init(struct dg_loop *loop, struct dg *dg, const struct dg_hardware *hardware);

/* One pass: handles commands, samples, reports and output; sleeps if nothing is left to do. */
void dg_loop_pass(struct dg_loop *loop);

#endif
