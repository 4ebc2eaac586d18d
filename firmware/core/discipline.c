// SPDX-License-Identifier: Apache-2.0

#include "discipline.h"

/* Long division in place of the 64-bit library division, which would cost flash for two uses at
 * power-up. */
static struct discipline_ratio ratio(uint64_t part, uint64_t whole)
{
    struct discipline_ratio result = {.share = 0, .shift = 0};

    for (; part << 1 < whole; part <<= 1)
        result.shift++;
    for (uint8_t bit = 0; bit < 32; bit++) {
        part <<= 1;
        result.share <<= 1;
        if (part >= whole) {
            part -= whole;
            result.share |= 1u;
        }
    }
    return result;
}

/* value · ratio · 2¹⁶, rounded */
static uint32_t scaled_q16(uint32_t value, const struct discipline_ratio *of)
{
    uint64_t product = (uint64_t)value * of->share;

    return (uint32_t)(((product >> (15u + of->shift)) + 1u) >> 1);
}

static void follow(struct discipline *d, uint32_t period)
{
    d->chip_q16 = scaled_q16(period, &d->chip);
    d->lead_q16 = scaled_q16(period, &d->lead);
}

void discipline_init(struct discipline *d, const struct tp_node_record *record,
                     uint32_t ticks_per_us)
{
    uint64_t period_ns = 1000u * (uint64_t)record->frame_period_us;

    d->follows = record->discipline;
    d->nominal = d->period = record->frame_period_us * ticks_per_us;
    d->last = 0;
    d->chip = ratio(record->chip_ns, period_ns);
    d->lead = ratio(1000u * TP_SYNC_LEAD * TP_SYNC_UNIT_US, period_ns);
    follow(d, d->nominal);
}

#define NOMINAL_SHIFT 3 /* 1/8: RC oscillators are up to 10 % off by the data sheet, and drift */
#define DRIFT_SHIFT 9   /* 1/512 from one period to another. Chosen: far above a clock's drift */

/* Whether two periods differ by no more than 2^-shift of the second one. */
static bool like(uint32_t period, uint32_t other, uint8_t shift)
{
    return (period > other ? period - other : other - period) <= other >> shift;
}

bool discipline_period(struct discipline *d, uint32_t ticks)
{
    uint32_t last = d->last;

    d->last = ticks;
    if (!like(ticks, d->nominal, NOMINAL_SHIFT))
        return false;
    /* Not followed: the pulse before came in another phase, and a node that it met awake took it late. */
    if (last && !like(ticks, last, DRIFT_SHIFT))
        return like(ticks, d->period, DRIFT_SHIFT);
    d->period = ticks;
    if (d->follows)
        follow(d, ticks);
    return true;
}
