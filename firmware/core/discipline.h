// SPDX-License-Identifier: Apache-2.0

/* Disciplines a node's clock: converts chip and lead to ticks of a timer that may be 10 % off, from
 * the measured distance of the frame pulses.
 *
 * Times are in ticks · 2¹⁶. A frame has at most 11 · 4096 = 45,056 edges, each summed with an error
 * of up to 2⁻¹⁷ tick: 0.34 tick in all, and at most one tick more for the measured period.
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
    bool follows;                  /* whether chip times follow the pulses */
    uint32_t nominal;              /* ticks of a frame period by an exact clock */
    uint32_t period;               /* ticks, last accepted */
    uint32_t last;                 /* ticks, last measured; 0: never */
    uint32_t chip_q16;             /* ticks · 2¹⁶ of a chip */
    uint32_t lead_q16;             /* … from a pulse to the first chip */
    struct discipline_ratio chip;  /* of the frame period */
    struct discipline_ratio lead;
};

void discipline_init(struct discipline *d, const struct tp_node_record *record,
                     uint32_t ticks_per_us);

/* Takes the distance of two successive frame pulses; returns whether the clock is known by it.
 *
 * It must be within 1/8 of the nominal period and, after the first, within 1/512 of the last accepted
 * or last measured one: a clock drifts slowly, but a restarted digitizer may pulse at any time. Chip
 * times follow it if it is the first, or like the last measured one. */
bool discipline_period(struct discipline *d, uint32_t ticks);

/* Ticks after a frame pulse before which no other pulse is taken for one: the shortest period that can
 * be accepted. It does not depend on the last accepted period, so a wrong one cannot hide the pulses
 * that correct it. */
static inline uint32_t discipline_earliest(const struct discipline *d)
{
    return d->nominal - (d->nominal >> 3);
}

#endif
