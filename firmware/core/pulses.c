// SPDX-License-Identifier: Apache-2.0

#include "pulses.h"

#include "turn.h"

#define LEAD_US (TP_SYNC_LEAD * TP_SYNC_UNIT_US)

void pulses_begin(struct pulses *pulses, const struct setup *setup)
{
    pulses->setup = setup;
    pulses->mark = setup->first_mark;
    pulses->frame = pulses->chip = 0;
    pulses->log2_groups = pulses->group = 0;
    pulses->announced = false;
    pulses->digits = 0;
    __asm__ volatile("" ::: "memory"); /* an interrupt may use the above once `on` is set */
    pulses->on = setup->marked;
}

void pulses_end(struct pulses *pulses)
{
    pulses->on = false;
    pulses->log2_asked = 0;
    pulses->number_asked = 0;
    __asm__ volatile("" ::: "memory"); /* the caller may change the setup from here on */
}

void pulses_divide(struct pulses *pulses, uint8_t log2_groups)
{
    pulses->log2_asked = log2_groups;
}

void pulses_number(struct pulses *pulses, uint16_t number, bool forget)
{
    uint16_t digits = (uint16_t)(number << TP_TURN_NUMBER_SHIFT) | (forget ? TP_TURN_FORGET : 0);

    pulses->number_asked = digits ? digits | TP_TURN_NUMBERS : 0;
}

uint8_t pulses_turn(const struct pulses *pulses, uint32_t frame)
{
    return pulses->turn[frame % PULSES_AHEAD];
}

/* The turn of the next frame, as the groups take it. */
static uint8_t take_turn(struct pulses *pulses)
{
    uint8_t asked = pulses->log2_asked;

    if (asked != pulses->log2_groups) {
        pulses->log2_groups = asked;
        pulses->group = 0;
    }
    if (asked == 0)
        return 0;
    uint8_t groups = (uint8_t)(1u << asked), group = pulses->group;
    pulses->group = (uint8_t)((group + 1u) & (groups - 1u));
    return groups | group;
}

/* Decides what the next frame's pulses say. */
static void announce_frame(struct pulses *pulses)
{
    uint16_t turn = take_turn(pulses), number = pulses->number_asked;

    if (number && pulses->frame > 0) /* before the first one there is no time for it */
        turn = number;
    pulses->turn[pulses->frame % PULSES_AHEAD] = turn & TURN_OF_GROUPS;
    pulses->digits = turn;
    pulses->announced = true;
}

/* Goes back from a frame's pulse to that of the highest digit left. */
static void take_digit(struct pulses *pulses, struct dg_pulse *pulse)
{
    uint8_t digit = TURN_DIGITS - 1u;

    while (!(pulses->digits >> digit))
        digit--;
    pulses->digits ^= (uint16_t)(1u << digit);
    pulse->tick -= (uint64_t)(digit + 1u) * TP_SYNC_DIGIT * TP_SYNC_UNIT_US * pulses->setup->ticks_per_us;
    pulse->units = TP_SYNC_RESTART;
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
        if (!pulses->announced)
            announce_frame(pulses);
        if (pulses->digits) {
            take_digit(pulses, pulse);
            return true;
        }
        pulse->units = TP_SYNC_FRAME;
        pulses->announced = false;
    }
    pulses->chip += resync_chips;
    if (resync_chips == 0 || pulses->chip >= setup->chips) {
        pulses->chip = 0;
        pulses->frame++;
        pulses->mark += setup->period_ticks;
    }
    return true;
}
