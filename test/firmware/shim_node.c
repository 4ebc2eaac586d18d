// SPDX-License-Identifier: Apache-2.0

/* What test_node_core.py needs of a node's core, as functions of plain numbers and arrays. */
#include "discipline.h"
#include "event.h"
#include "frame.h"
#include "sequencer.h"
#include "sync_pulse.h"
#include "turn.h"

/* Levels of a frame of `span` chips: 1, -1, in a guard 0. Returns how many it has. */
uint32_t shim_frame(const struct tp_node_record *record, const uint8_t *row, uint16_t code,
                    int8_t *levels, uint32_t span)
{
    struct sequencer sequencer;
    uint32_t place = 0;
    enum sequencer_next next;

    sequencer_init(&sequencer, record, row);
    sequencer_start(&sequencer, code);
    do {
        if (place < span)
            levels[place] = sequencer_level(&sequencer) ? 1 : -1;
        place++;
        next = sequencer_step(&sequencer);
        if (next == SEQUENCER_GUARD)
            place += record->guard_chips;
    } while (next != SEQUENCER_END && place < span);
    return place;
}

/* Whether the node talks in each of `size` frames: whose pulse it missed, whose turn they were, TP_TURN_ASKED among
 * its digits. */
void shim_events(const struct tp_node_record *record, uint16_t rest, const uint16_t *codes,
                 const uint8_t *missed, const uint8_t *turns, uint8_t *talks, size_t size)
{
    struct event event;

    event_init(&event, record, rest);
    for (size_t i = 0; i < size; i++) {
        bool others = !missed[i] && turn_is_others(turns[i], record->node);

        talks[i] = !missed[i] && !others && (turns[i] & TP_TURN_ASKED || event_talks(&event, codes[i]));
        event_frame(&event, others, talks[i], codes[i]);
    }
}

/* After one measured period: whether it was believed; chip, lead, period and earliest next pulse. */
bool shim_discipline(const struct tp_node_record *record, uint32_t ticks_per_us, uint32_t measured,
                     uint32_t result[4])
{
    struct discipline clock;
    bool believed;

    discipline_init(&clock, record, ticks_per_us);
    believed = discipline_period(&clock, measured);
    result[0] = clock.chip_q16;
    result[1] = clock.lead_q16;
    result[2] = clock.period;
    result[3] = discipline_earliest(&clock);
    return believed;
}

uint16_t shim_turn_digit(uint32_t ticks, uint16_t digit_ticks)
{
    return turn_digit(ticks, digit_ticks);
}

uint8_t shim_pulse(uint32_t ticks, uint16_t unit_ticks)
{
    return sync_pulse_units(ticks, unit_ticks);
}
