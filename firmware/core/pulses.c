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
    pulses->words_left = 0;
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
    pulses->words_begun = pulses->words_asked;
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

void pulses_ask(struct pulses *pulses, uint8_t log2_groups)
{
    pulses->words_log2 = log2_groups;
    pulses->words_asked++;
}

uint8_t pulses_turn(const struct pulses *pulses, uint32_t frame)
{
    return pulses->turn[frame % PULSES_AHEAD];
}

/* The turn of the next frame, as the groups take it. Where all are asked to speak a round of turns begins, in
 * which the groups stay. */
static uint8_t take_turn(struct pulses *pulses)
{
    uint8_t log2 = pulses->log2_asked, words = pulses->words_asked;
    bool begins = words != pulses->words_begun;

    if (begins) {
        pulses->words_begun = words;
        log2 = pulses->words_log2 > log2 ? pulses->words_log2 : log2;
        pulses->words_left = (uint8_t)(1u << log2);
    } else if (pulses->words_left) {
        log2 = pulses->log2_groups;
    }
    if (begins || log2 != pulses->log2_groups) {
        pulses->log2_groups = log2;
        pulses->group = 0;
    }
    uint8_t groups = (uint8_t)(1u << log2), group = pulses->group;
    uint8_t asked = 0;
    pulses->group = (uint8_t)((group + 1u) & (groups - 1u));
    if (pulses->words_left) {
        pulses->words_left--;
        asked = TP_TURN_ASKED;
    }
    return log2 ? asked | groups | group : asked;
}

/* Decides what the next frame's pulses say. */
static void announce_frame(struct pulses *pulses)
{
    uint16_t number = pulses->number_asked;
    /* before the first one there is no time for it */
    uint16_t turn = number && pulses->frame > 0 ? number : take_turn(pulses);

    pulses->turn[pulses->frame % PULSES_AHEAD] =
        (uint8_t)(turn & (turn_has_number(turn) ? TURN_OF_GROUPS : TURN_OF_GROUPS | TP_TURN_ASKED));
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
