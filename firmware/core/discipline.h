// SPDX-License-Identifier: Apache-2.0

/* A node's clock against the digitizer's: what a chip and the lead are in ticks of a timer that may
 * be 10 % off, told by the distance of the frame pulses.
 *
 * Times come as ticks · 2¹⁶, so that edges that are added up from a frame's start (45,056 of them at
 * most) are off by less than a tick: half a unit of 2⁻¹⁶ per chip, and one tick of the measured
 * period, of which a frame is a part.
 */
#ifndef TACTILE_DISCIPLINE_H
#define TACTILE_DISCIPLINE_H

#include <stdbool.h>
#include <stdint.h>

#include "tactile_protocol.h"

/* A ratio below 1: share · 2^-(32 + shift), with the top bit of share set. */
struct discipline_ratio {
    uint32_t share;
    uint8_t shift;
};

struct discipline {
    bool follows;                  /* whether chips follow the pulses */
    uint32_t nominal;              /* ticks of a frame period, if the clock is right */
    uint32_t period;               /* ticks, as last believed */
    uint32_t last;                 /* ticks, as last measured; 0: never */
    uint32_t chip_q16;             /* ticks · 2¹⁶ of a chip */
    uint32_t lead_q16;             /* … and from a pulse to the first chip */
    struct discipline_ratio chip;  /* of the frame period */
    struct discipline_ratio lead;
};

void discipline_init(struct discipline *d, const struct tp_node_record *record,
                     uint32_t ticks_per_us);

/* Two successive frame pulses came `ticks` apart. Believed if that is what a clock no more than an
 * eighth off makes of a frame period, and, but for the first time, if it is like the one that was last
 * believed or last measured: a clock drifts by little, but a digitizer that starts anew may pulse at
 * any time. Returns whether it was. */
bool discipline_period(struct discipline *d, uint32_t ticks);

/* Ticks after a frame pulse before which no other can be one: the shortest period that is believed,
 * whatever the last one was, so that a wrong one doesn't hide the pulses that would mend it. */
static inline uint32_t discipline_earliest(const struct discipline *d)
{
    return d->nominal - (d->nominal >> 3);
}

#endif
