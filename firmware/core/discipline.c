#include "discipline.h"

/* Long division: a node needs it twice in its life, and has no other use for a 64-bit one. */
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
    d->chip = ratio(record->chip_ns, period_ns);
    d->lead = ratio(1000u * TP_SYNC_LEAD * TP_SYNC_UNIT_US, period_ns);
    follow(d, d->nominal);
}

static uint32_t distance(uint32_t a, uint32_t b)
{
    return a > b ? a - b : b - a;
}

bool discipline_period(struct discipline *d, uint32_t ticks)
{
    if (distance(ticks, d->nominal) > d->nominal >> 3)
        return false;
    d->period = ticks;
    if (d->follows)
        follow(d, ticks);
    return true;
}

bool discipline_agrees(const struct discipline *d, uint32_t ticks)
{
    uint32_t wandered = d->period >> 9;
    uint32_t late = d->lead_q16 >> (16u + 2u); /* a quarter of the lead's 64 µs */

    return distance(ticks, d->period) <= (wandered > late ? wandered : late);
}
