// SPDX-License-Identifier: Apache-2.0

#include "event.h"

void event_init(struct event *e, const struct tp_node_record *record, uint16_t rest)
{
    e->threshold = record->threshold;
    e->rest = rest;
    e->last_sent = rest;
    e->heartbeat = record->heartbeat;
    e->owes = false;
    e->to_heartbeat = record->turn;
}

bool event_talks(const struct event *e, uint16_t code)
{
    return e->threshold == 0 || event_farther(code, e->rest, e->threshold) ||
           event_farther(code, e->last_sent, e->threshold) || e->owes ||
           (e->heartbeat && e->to_heartbeat == 0);
}

void event_frame(struct event *e, bool others, bool spoke, uint16_t code)
{
    if (spoke) {
        e->last_sent = code;
        e->owes = false;
    }
    if (e->heartbeat && e->to_heartbeat-- == 0) {
        e->to_heartbeat = (uint16_t)(e->heartbeat - 1u);
        e->owes |= others;
    }
}
