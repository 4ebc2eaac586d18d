// SPDX-License-Identifier: Apache-2.0

#include "setup.h"

#include "frame.h"
#include "turn.h"

#define LEAD_US (TP_SYNC_LEAD * TP_SYNC_UNIT_US)

const struct tp_configure setup_default = {
    .frame = {
        .nodes = 16,
        .bits = 10,
        .order = 20,
        .chip_ns = 50000,
        .frame_period_us = 12800,
        .first_row = 1,
        .sign_seed = 1,
        .signs = TP_SIGNS_SCRAMBLED,
        .polarity = TP_POLARITY_NORMAL,
        .samples_per_chip = 4,
    },
    .sync_mode = TP_SYNC_MODE_DRIVE,
};

/* Chip duration in thousandths of a tick. */
static uint64_t chip_length(const struct setup *setup)
{
    return (uint64_t)setup->asked.frame.chip_ns * setup->ticks_per_us;
}

static uint32_t place(const struct setup *setup, uint32_t chip)
{
    return frame_place(chip, setup->asked.frame.resync_chips, setup->asked.frame.guard_chips);
}

uint64_t setup_chip_place(const struct setup *setup, uint32_t chip)
{
    return place(setup, chip) * chip_length(setup);
}

/* Whether the pulse of a turn's highest digit comes two leads after a frame. */
static bool has_digits(const struct setup *setup, uint64_t digits)
{
    const struct tp_frame_layout *frame = &setup->asked.frame;
    uint64_t turn_us = (digits * TP_SYNC_DIGIT + 3 * TP_SYNC_LEAD) * TP_SYNC_UNIT_US;

    return setup->marked && (place(setup, setup->chips - 1) + 1ull) * frame->chip_ns + turn_us * 1000 <=
                                frame->frame_period_us * 1000ull;
}

bool setup_has_turns(const struct setup *setup)
{
    return has_digits(setup, TP_TURN_MOST_LOG2 + 1u);
}

bool setup_can_ask(const struct setup *setup)
{
    return has_digits(setup, TP_TURN_MOST_LOG2 + 2u);
}

/* From the pulse of a frame's last sub-slot to the next frame's. */
static uint64_t last_pulse_ns(const struct setup *setup)
{
    const struct tp_frame_layout *frame = &setup->asked.frame;
    uint32_t slots = frame->resync_chips ? (setup->chips - 1) / frame->resync_chips : 0;

    return frame->frame_period_us * 1000ull -
           (uint64_t)place(setup, slots * frame->resync_chips) * frame->chip_ns;
}

bool setup_has_numbers(const struct setup *setup)
{
    /* the highest digit's pulse comes two leads after that */
    uint64_t digits_us = (TURN_DIGITS * TP_SYNC_DIGIT + 2 * TP_SYNC_LEAD) * TP_SYNC_UNIT_US;

    return setup->marked && last_pulse_ns(setup) >= digits_us * 1000;
}

/* Whether a frame fits its period, and successive pulses of the sync line are two leads apart. */
static bool timely(const struct setup *setup)
{
    const struct tp_frame_layout *frame = &setup->asked.frame;
    uint64_t period_ns = frame->frame_period_us * 1000ull;
    uint64_t between_ns = period_ns;

    if ((place(setup, setup->chips - 1) + 1ull) * frame->chip_ns > period_ns)
        return false;
    if (!setup->marked)
        return frame->resync_chips == 0 && !setup->asked.integrated;
    if (frame->resync_chips && setup->chips > frame->resync_chips) {
        uint64_t slot_ns = (uint64_t)place(setup, frame->resync_chips) * frame->chip_ns;
        between_ns = last_pulse_ns(setup);
        if (slot_ns < between_ns)
            between_ns = slot_ns;
    }
    return between_ns >= 2 * LEAD_US * 1000ull;
}

/* Raw samples: the sampling period is rounded to a whole tick. Refused if that makes samples_per_chip
 * of them differ from a chip by more than 1 % (chosen). */
static bool sample_raw(struct setup *setup, const struct dg_board *board)
{
    uint64_t chip = chip_length(setup);
    uint64_t per_tick = (uint64_t)setup->asked.frame.samples_per_chip * STRIDE_MILLI;
    uint64_t ticks = (chip + per_tick / 2) / per_tick;
    uint64_t taken = ticks * per_tick;
    uint64_t error = taken > chip ? taken - chip : chip - taken;

    if (ticks < board->min_ticks || ticks > board->max_ticks || error * 100 > chip)
        return false;
    setup->ticks_per_sample = (uint32_t)ticks;
    setup->sample_rate_uhz = (setup->ticks_per_us * 1000000000000ull + ticks / 2) / ticks;
    return true;
}

/* Means of chips: averages as many evenly spaced samples as the converter can take. Few of them would
 * include one that is taken before the line has settled: then a single late one is better. It stays late
 * only where a chip is a whole number of ticks; otherwise samples would drift through the chips. */
static bool sample_means(struct setup *setup, const struct dg_board *board)
{
    uint64_t chip_ticks = chip_length(setup) / STRIDE_MILLI;
    uint64_t mean = chip_ticks / board->min_ticks;
    uint32_t chip_ns = setup->asked.frame.chip_ns;

    if (mean > SETUP_MAX_MEAN)
        mean = SETUP_MAX_MEAN;
    if (mean < setup->asked.frame.samples_per_chip)
        return false;
    if (mean < SETUP_LEAST_MEAN && setup->asked.frame.samples_per_chip == 1)
        mean = 1;
    if (chip_ticks / mean > board->max_ticks || (mean == 1 && chip_length(setup) % STRIDE_MILLI != 0))
        return false;
    setup->ticks_per_sample = (uint32_t)(chip_ticks / mean);
    setup->sample_rate_uhz = (1000000000000000ull + chip_ns / 2) / chip_ns;
    return true;
}

static uint32_t quiet_counts(const struct setup *setup, const struct dg_board *board)
{
    double volts_per_count = (double)board->volts_per_count;

    if (!setup->marked)
        return 0;
    if (setup->asked.integrated)
        volts_per_count /= SETUP_MEAN_SCALE;
    double counts = setup->asked.quiet_uv * 1e-6 / volts_per_count;
    return counts < UINT16_MAX ? (uint32_t)counts : UINT16_MAX;
}

/* By which another's frame may be heard off its time, µs: both digitizers' reading of whole µs, and an interrupt's
 * latency. Chosen: twice what the emulated RP2040 shows. */
#define HEARD_US 4

/* Whether frames can follow another's: a gap is longer than they are moved, by a sample at least. */
static bool can_follow(const struct setup *setup)
{
    uint64_t moved = setup_most_moved(setup);

    return setup->frame_samples * setup->ticks_per_sample + 2 * moved <= setup->period_ticks &&
           moved >= setup->ticks_per_sample + HEARD_US * (uint64_t)setup->ticks_per_us;
}

bool setup_make(struct setup *setup, const struct dg_board *board,
                const struct tp_configure *asked)
{
    const struct tp_frame_layout *frame = &asked->frame;
    struct setup new = {.asked = *asked, .ticks_per_us = board->ticks_per_us};

    new.marked = asked->sync_mode != TP_SYNC_MODE_NONE;
    if (new.marked)
        new.asked.sync_mode = asked->sync_mode == TP_SYNC_MODE_HEAR && board->hears ? TP_SYNC_MODE_HEAR
                                                                                    : TP_SYNC_MODE_DRIVE;
    new.chips = frame_line_bits(frame->bits, frame->parity) * frame->order;
    if (!timely(&new) || (!new.marked && asked->sync_wire != TP_SYNC_WIRE_OWN))
        return false;
    if (!(asked->integrated ? sample_means(&new, board) : sample_raw(&new, board)))
        return false;

    uint32_t ticks = new.ticks_per_sample, sample = ticks * STRIDE_MILLI;
    uint64_t chip = chip_length(&new);
    uint64_t span = place(&new, new.chips - 1) + 1ull + TP_TAIL_CHIPS;
    uint64_t first = DG_FIRST_MARK_US * (uint64_t)new.ticks_per_us;
    uint64_t packet = TP_MAX_PACKET_US * (uint64_t)new.ticks_per_us / ticks;

    new.first_mark = (first + ticks - 1) / ticks * ticks;
    new.period_ticks = (uint64_t)frame->frame_period_us * new.ticks_per_us;
    new.period = stride_of(new.period_ticks * STRIDE_MILLI, sample);
    new.chip = stride_of(chip, sample);
    new.guard = stride_of(chip * frame->guard_chips, sample);
    new.samples_are_chips = asked->integrated && new.chip.samples == 1 && new.chip.rest == 0;
    /* A chip's only sample is taken when the line has settled: at 7/8, instead of in the middle. */
    new.early_ticks = new.samples_are_chips ? ticks * 3u / 8u : 0;
    new.frame_samples = (span * chip + sample - 1) / sample;
    new.gap_samples = packet > TP_MAX_SAMPLES ? TP_MAX_SAMPLES : packet ? (uint32_t)packet : 1;
    new.quiet_counts = quiet_counts(&new, board);
    if (new.asked.sync_mode == TP_SYNC_MODE_HEAR && !can_follow(&new))
        return false;
    *setup = new;
    return true;
}
