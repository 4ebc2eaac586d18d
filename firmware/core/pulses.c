// SPDX-License-Identifier: Apache-2.0

#include "pulses.h"

#define LEAD_US (TP_SYNC_LEAD * TP_SYNC_UNIT_US)

void pulses_begin(struct pulses *pulses, const struct setup *setup)
{
    pulses->setup = setup;
    pulses->mark = setup->first_mark;
    pulses->frame = pulses->chip = pulses->turns = 0;
    __asm__ volatile("" ::: "memory"); /* an interrupt may use the above once `on` is set */
    pulses->on = setup->marked;
}

void pulses_end(struct pulses *pulses)
{
    pulses->on = false;
    pulses->call_asked = false;
    __asm__ volatile("" ::: "memory"); /* the caller may change the setup from here on */
}

void pulses_call(struct pulses *pulses)
{
    pulses->call_asked = true;
}

static uint32_t bit(uint32_t frame)
{
    return 1u << frame % PULSES_AHEAD;
}

bool pulses_called(const struct pulses *pulses, uint32_t frame)
{
    return pulses->called & bit(frame);
}

static uint8_t begin_frame(struct pulses *pulses)
{
    bool begins = pulses->call_asked;

    if (begins) {
        pulses->call_asked = false;
        pulses->turns = pulses->setup->asked.frame.nodes;
    }
    if (pulses->turns) {
        pulses->turns--;
        pulses->called |= bit(pulses->frame);
    } else {
        pulses->called &= ~bit(pulses->frame);
    }
    return begins ? TP_SYNC_CALL : TP_SYNC_FRAME;
}

bool pulses_next(struct pulses *pulses, struct dg_pulse *pulse)
{
    if (!pulses->on)
        return false;

    const struct setup *setup = pulses->setup;
    uint16_t resync_chips = setup->asked.frame.resync_chips;
    pulse->tick = pulses->mark - LEAD_US * setup->ticks_per_us - setup->early_ticks;
    if (pulses->chip) {
        uint64_t place = setup_chip_place(setup, pulses->chip);
        pulse->tick += (place + STRIDE_MILLI / 2) / STRIDE_MILLI;
        pulse->units = TP_SYNC_RESTART;
    } else {
        pulse->units = begin_frame(pulses);
    }
    pulses->chip += resync_chips;
    if (resync_chips == 0 || pulses->chip >= setup->chips) {
        pulses->chip = 0;
        pulses->frame++;
        pulses->mark += setup->period_ticks;
    }
    return true;
}
