// SPDX-License-Identifier: Apache-2.0

#include "pulses.h"

#include "turn.h"

#define LEAD_US (TP_SYNC_LEAD * TP_SYNC_UNIT_US)
/* Periods for which a frame that was heard tells when others begin: two crystals of 50 ppm part by 8 µs in 20 ms. */
#define FRESH 4

void pulses_begin(struct pulses *pulses, const struct setup *setup, uint64_t start_us)
{
    pulses->setup = setup;
    pulses->start_us = (uint32_t)start_us;
    pulses->strayed = 0;
    for (uint32_t i = 0; i < PULSES_AHEAD; i++)
        pulses->moved[i] = 0;
    pulses->walk = pulses_first(setup);
    pulses->log2_groups = pulses->group = 0;
    pulses->words_left = 0;
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
    uint16_t turn = pulses->digits[frame % PULSES_AHEAD];

    return (uint8_t)(turn & (turn_has_number(turn) ? TURN_OF_GROUPS : TURN_OF_GROUPS | TP_TURN_ASKED));
}

void pulses_heard(struct pulses *pulses, uint32_t us)
{
    pulses->heard_us = us;
    pulses->is_heard = true;
}

/* µs from a moment, modulo 2³², to the nearest frame that is heard, if one was lately. */
static bool to_heard(const struct pulses *pulses, const struct setup *setup, uint32_t us, int32_t *left_us)
{
    int32_t period_us = (int32_t)setup->asked.frame.frame_period_us;
    int32_t left = (int32_t)(pulses->heard_us - us);

    for (uint32_t i = 0; i < FRESH && left < -period_us / 2; i++)
        left += period_us;
    *left_us = left;
    return pulses->is_heard && left >= -period_us / 2 && left <= period_us / 2;
}

uint64_t pulses_first_mark(const struct pulses *pulses, const struct setup *setup, uint64_t start_us)
{
    uint64_t mark = (uint64_t)DG_FIRST_MARK_US * setup->ticks_per_us;
    uint32_t ticks = setup->ticks_per_sample;
    int32_t left_us;

    if (setup->asked.sync_mode == TP_SYNC_MODE_HEAR &&
        to_heard(pulses, setup, (uint32_t)start_us + DG_FIRST_MARK_US, &left_us)) {
        if (left_us < 0)
            left_us += (int32_t)setup->asked.frame.frame_period_us;
        mark += (uint64_t)left_us * setup->ticks_per_us;
    }
    return (mark + ticks - 1) / ticks * ticks;
}

/* Decides by how many samples the next frame comes later than it would, to begin with those that are heard. */
static int8_t follow_heard(struct pulses *pulses, uint64_t mark)
{
    const struct setup *setup = pulses->setup;
    int32_t left_us, samples = (int32_t)setup->ticks_per_sample, left;

    if (setup->asked.sync_mode != TP_SYNC_MODE_HEAR)
        return 0;
    if (!to_heard(pulses, setup, pulses->start_us + (uint32_t)(mark / setup->ticks_per_us), &left_us)) {
        pulses->is_heard = false; /* else it would be near again after 2³² µs */
        pulses->unheard++;
        return 0;
    }
    uint32_t away_us = (uint32_t)(left_us < 0 ? -left_us : left_us);
    if (away_us * (uint64_t)setup->ticks_per_us > setup_most_moved(setup)) {
        if (pulses->strayed < PULSES_STRAYED)
            pulses->strayed++;
        return 0;
    }
    pulses->strayed = 0;
    left = left_us * (int32_t)setup->ticks_per_us;
    return (int8_t)((left + (left < 0 ? -samples : samples) / 2) / samples);
}

int8_t pulses_moved(const struct pulses *pulses, uint32_t frame)
{
    return pulses->moved[frame % PULSES_AHEAD];
}

bool pulses_strayed(const struct pulses *pulses)
{
    return pulses->strayed >= PULSES_STRAYED;
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
    uint32_t frame = pulses->walk.frame;
    uint16_t number = pulses->number_asked;

    /* before the first one there is no time for it */
    pulses->digits[frame % PULSES_AHEAD] = number && frame > 0 ? number : take_turn(pulses);
    pulses->moved[frame % PULSES_AHEAD] = frame > 0 ? follow_heard(pulses, pulses->walk.mark) : 0;
}

/* Goes back from a frame's pulse to that of the highest digit left. */
static void take_digit(struct pulse_walk *walk, const struct setup *setup, struct dg_pulse *pulse)
{
    uint8_t digit = TURN_DIGITS - 1u;

    while (!(walk->digits >> digit))
        digit--;
    walk->digits ^= (uint16_t)(1u << digit);
    pulse->tick -= (uint64_t)(digit + 1u) * TP_SYNC_DIGIT * TP_SYNC_UNIT_US * setup->ticks_per_us;
    pulse->units = TP_SYNC_RESTART;
}

struct pulse_walk pulses_first(const struct setup *setup)
{
    return (struct pulse_walk){.mark = setup->first_mark};
}

void pulses_follow(const struct pulses *pulses, struct pulse_walk *walk, struct dg_pulse *pulse)
{
    const struct setup *setup = pulses->setup;
    uint16_t resync_chips = setup->asked.frame.resync_chips;

    if (!walk->chip && !walk->announced) {
        walk->mark += (uint64_t)((int64_t)pulses_moved(pulses, walk->frame) * setup->ticks_per_sample);
        walk->digits = pulses->digits[walk->frame % PULSES_AHEAD];
        walk->announced = true;
    }
    pulse->tick = walk->mark - LEAD_US * setup->ticks_per_us - setup->early_ticks;
    if (walk->chip) {
        uint64_t place = setup_chip_place(setup, walk->chip);
        pulse->tick += (place + STRIDE_MILLI / 2) / STRIDE_MILLI;
        pulse->units = TP_SYNC_RESTART;
    } else {
        if (walk->digits) {
            take_digit(walk, setup, pulse);
            return;
        }
        pulse->units = TP_SYNC_FRAME;
        walk->announced = false;
    }
    walk->chip += resync_chips;
    if (resync_chips == 0 || walk->chip >= setup->chips) {
        walk->chip = 0;
        walk->frame++;
        walk->mark += setup->period_ticks;
    }
}

bool pulses_next(struct pulses *pulses, struct dg_pulse *pulse)
{
    if (!pulses->on)
        return false;
    if (!pulses->walk.chip && !pulses->walk.announced)
        announce_frame(pulses);
    pulses_follow(pulses, &pulses->walk, pulse);
    return true;
}
