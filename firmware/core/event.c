// SPDX-License-Identifier: Apache-2.0

#include "event.h"

void event_init(struct event *e, const struct tp_node_record *record, uint16_t rest)
{
    e->record = record;
    e->rest = rest;
    e->last_sent = rest;
    e->owes = false;
    e->to_heartbeat = record->turn;
    e->to_step = record->follow;
    e->steps = 0;
}

bool event_talks(const struct event *e, uint16_t code)
{
    const struct tp_node_record *record = e->record;

    return record->threshold == 0 || (record->follow && event_farther(code, e->rest, record->threshold)) ||
           event_farther(code, e->last_sent, record->threshold) || e->owes ||
           (record->heartbeat && e->to_heartbeat == 0);
}

/* A step of the rest to the code, by 1; while that is off by more than the threshold, by so many LSB, only every
 * 2^(off - 1)th. */
static void follow(struct event *e, uint16_t code)
{
    int16_t off = (int16_t)(code - e->rest), by = 1;
    uint16_t steps = ++e->steps;

    if (off < 0) {
        off = -off;
        by = -1;
    }
    if ((uint16_t)off > e->record->threshold)
        for (; off > 1; off--, steps >>= 1)
            if (steps & 1u)
                return;
    if (off)
        e->rest = (uint16_t)(e->rest + by);
}

void event_frame(struct event *e, bool others, bool spoke, uint16_t code)
{
    const struct tp_node_record *record = e->record;

    if (spoke) {
        e->last_sent = code;
        e->owes = false;
    }
    if (record->heartbeat && e->to_heartbeat-- == 0) {
        e->to_heartbeat = (uint16_t)(record->heartbeat - 1u);
        e->owes |= others;
    }
    if (--e->to_step == 0) {
        e->to_step = record->follow;
        follow(e, code);
    }
}
