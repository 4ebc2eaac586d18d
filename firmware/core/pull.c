// SPDX-License-Identifier: Apache-2.0

#include "pull.h"

#define LEAD_US (TP_SYNC_LEAD * TP_SYNC_UNIT_US)
#define REPEATED 64u /* samples passed on at once. Chosen: they lie on the stack */

/* The first sample that is taken at `tick` or after it; each is taken in the middle of its period. */
static uint64_t sample_at(const struct setup *setup, uint64_t tick)
{
    uint32_t ticks = setup->ticks_per_sample;

    return (tick + ticks - 1 - ticks / 2) / ticks;
}

/* Goes to the next pulse. It is judged if it is a frame's, and so long that a sample falls into its second half. */
static void next(struct pull *pull)
{
    const struct setup *setup = pull->pulses->setup;
    uint32_t unit = TP_SYNC_UNIT_US * setup->ticks_per_us;

    pulses_follow(pull->pulses, &pull->walk, &pull->pulse);
    pull->from = sample_at(setup, pull->pulse.tick);
    pull->to = sample_at(setup, pull->pulse.tick + LEAD_US * setup->ticks_per_us);
    pull->judged = pull->pulse.units != TP_SYNC_FRAME || setup->ticks_per_sample > unit;
}

void pull_begin(struct pull *pull, const struct pulses *pulses, const struct dg_board *board)
{
    const struct setup *setup = pulses->setup;

    pull->on = setup->asked.sync_wire == TP_SYNC_WIRE_DATA;
    pull->pulses = pulses;
    pull->walk = pulses_first(setup);
    pull->position = 0;
    pull->from = pull->to = 0; /* the first pulse is known once it has been taken */
    pull->judged = true;
    pull->last = (uint16_t)board->zero_count;
    /* Chosen: half of what it moves from half the supply to ground, or the amplifier to its rail */
    pull->swing = (uint16_t)((board->max_count - board->min_count) / 4);
}

static void look(struct pull *pull, const uint16_t *counts, size_t size)
{
    for (size_t i = 0; i < size && !pull->judged; i++) {
        int32_t step = counts[i] - pull->last;
        pull->judged = step > pull->swing || step < -pull->swing;
    }
}

static void repeat(const struct pull *pull, struct stream *stream, size_t size)
{
    uint16_t same[REPEATED];

    for (size_t i = 0; i < REPEATED && i < size; i++)
        same[i] = pull->last;
    for (; size > REPEATED; size -= REPEATED)
        stream_samples(stream, same, REPEATED);
    stream_samples(stream, same, size);
}

/* Samples left, of `size`, up to where repeating begins or ends. */
static size_t left(struct pull *pull, size_t size)
{
    if (pull->position == pull->to) {
        pull->unseen += !pull->judged;
        next(pull);
    }
    uint64_t end = pull->position < pull->from ? pull->from : pull->to;
    return end - pull->position < size ? (size_t)(end - pull->position) : size;
}

void pull_samples(struct pull *pull, struct stream *stream, const uint16_t *counts, size_t size)
{
    if (!pull->on) {
        stream_samples(stream, counts, size);
        return;
    }
    while (size) {
        size_t taken = left(pull, size);
        if (pull->position < pull->from) {
            pull->last = counts[taken - 1];
            stream_samples(stream, counts, taken);
        } else {
            look(pull, counts, taken);
            repeat(pull, stream, taken);
        }
        pull->position += taken;
        counts += taken;
        size -= taken;
    }
}

void pull_lost(struct pull *pull, struct stream *stream, uint32_t size)
{
    stream_lost(stream, size);
    while (pull->on && size) {
        uint32_t lost = (uint32_t)left(pull, size);
        pull->judged |= pull->position >= pull->from;
        pull->position += lost;
        size -= lost;
    }
}
