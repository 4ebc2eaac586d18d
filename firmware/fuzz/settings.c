// SPDX-License-Identifier: Apache-2.0

#include "reference.h"

#define LEAD_NS (1000 * TP_SYNC_LEAD * TP_SYNC_UNIT_US)
#define FIRST_MARK_US 1000
#define MEAN_SCALE 8
#define MAX_MEAN 4096

static bool within(wide low, wide value, wide high)
{
    return low <= value && value <= high;
}

static bool in_range(const struct tp_configure *asked)
{
    const struct tp_frame_layout *frame = &asked->frame;

    return frame->nodes >= 1 && within(8, frame->bits, 16) && within(1, frame->order, 65536) &&
           within(10, frame->chip_ns, 1000000000) && frame->frame_period_us >= 1 &&
           frame->signs <= 3 && frame->drive <= 1 &&
           (frame->polarity == 1 || frame->polarity == -1) && frame->samples_per_chip >= 1 &&
           frame->parity <= 1 && asked->sync_mode <= 2 && asked->integrated <= 1 &&
           asked->sync_wire <= 1;
}

static wide place(const struct tp_frame_layout *frame, wide chip)
{
    return frame->resync_chips ? chip + chip / frame->resync_chips * frame->guard_chips : chip;
}

/* Whether neither frames nor their pulses overlap: each pulse has to end before the next begins, and
 * announces what comes one lead later. */
static bool timely(const struct settings *settings)
{
    const struct tp_frame_layout *frame = &settings->asked.frame;
    wide period_ns = (wide)1000 * frame->frame_period_us, chips = settings->chips;
    wide between_ns = period_ns;

    if ((place(frame, chips - 1) + 1) * frame->chip_ns > period_ns)
        return false;
    if (!settings->marked)
        return !frame->resync_chips && !settings->asked.integrated;
    if (frame->resync_chips && chips > frame->resync_chips) { /* but the last, all are as the first */
        wide last = (chips - 1) / frame->resync_chips * frame->resync_chips;
        wide first_ns = place(frame, frame->resync_chips) * frame->chip_ns;
        wide last_ns = period_ns - place(frame, last) * frame->chip_ns;
        between_ns = first_ns < last_ns ? first_ns : last_ns;
    }
    return between_ns >= 2 * LEAD_NS;
}

static bool sampled(struct settings *settings, const struct dg_board *board)
{
    wide chip = settings->chip, wanted = settings->asked.frame.samples_per_chip, ticks;

    if (settings->asked.integrated) {
        wide mean = chip / 1000 / board->min_ticks;
        mean = mean < MAX_MEAN ? mean : MAX_MEAN;
        if (mean < wanted)
            return false;
        if (mean < 4 && wanted == 1) /* too few to leave out what is not settled */
            mean = 1;
        if (mean == 1 && chip % 1000) /* that one would not stay where the line is settled */
            return false;
        ticks = chip / 1000 / mean;
    } else {
        ticks = (chip + 500 * wanted) / (1000 * wanted);
        wide error = 1000 * wanted * ticks - chip;
        if (!within(-chip, 100 * error, chip))
            return false;
    }
    settings->ticks_per_sample = (uint32_t)ticks;
    return within(board->min_ticks, ticks, board->max_ticks);
}

enum tp_result settings_of(struct settings *settings, const struct dg_board *board,
                           const struct tp_configure *asked)
{
    const struct tp_frame_layout *frame = &asked->frame;
    struct settings new = {.asked = *asked, .ticks_per_us = board->ticks_per_us};
    double volts = (double)board->volts_per_count / (asked->integrated ? MEAN_SCALE : 1);
    double quiet = asked->quiet_uv * 1e-6 / volts;

    if (!in_range(asked))
        return TP_RESULT_OUT_OF_RANGE;
    new.marked = asked->sync_mode != TP_SYNC_MODE_NONE;
    if (new.marked)
        new.asked.sync_mode = TP_SYNC_MODE_DRIVE;
    new.chips = (uint32_t)(frame->bits + frame->parity) * frame->order;
    new.chip = (wide)frame->chip_ns * board->ticks_per_us;
    new.period = (wide)1000 * frame->frame_period_us * board->ticks_per_us;
    if (asked->sync_wire && !new.marked)
        return TP_RESULT_UNSUPPORTED;
    if (!timely(&new) || !sampled(&new, board))
        return TP_RESULT_UNSUPPORTED;
    wide sample = (wide)1000 * new.ticks_per_sample;
    wide first = (wide)1000 * FIRST_MARK_US * board->ticks_per_us;
    new.first_mark = (first + sample - 1) / sample * sample;
    new.quiet_counts = !new.marked ? 0 : quiet < UINT16_MAX ? (uint32_t)quiet : UINT16_MAX;
    *settings = new;
    return TP_RESULT_OK;
}

wide settings_chip(const struct settings *settings, uint32_t chip)
{
    return place(&settings->asked.frame, chip) * settings->chip;
}

bool settings_has_turns(const struct settings *settings)
{
    wide end = settings_chip(settings, settings->chips - 1) + settings->chip;

    return settings->marked && end + (wide)832000 * settings->ticks_per_us <= settings->period;
}

bool settings_can_ask(const struct settings *settings)
{
    wide end = settings_chip(settings, settings->chips - 1) + settings->chip;

    return settings->marked && end + (wide)960000 * settings->ticks_per_us <= settings->period;
}

bool settings_has_numbers(const struct settings *settings)
{
    uint32_t resync = settings->asked.frame.resync_chips;
    wide last = resync ? settings_chip(settings, (settings->chips - 1) / resync * resync) : 0;

    return settings->marked && last + (wide)2176000 * settings->ticks_per_us <= settings->period;
}

uint64_t settings_sample(const struct settings *settings, wide time)
{
    wide sample = (wide)1000 * settings->ticks_per_sample;

    return (uint64_t)((time + sample / 2 - 1) / sample);
}

uint64_t settings_mark(const struct settings *settings, uint64_t frame)
{
    return settings_sample(settings, settings->first_mark + frame * settings->period);
}

uint64_t settings_us(const struct settings *settings, wide time)
{
    wide us = (wide)1000 * settings->ticks_per_us;

    return (uint64_t)((time + us / 2) / us);
}
