// SPDX-License-Identifier: Apache-2.0

/* When a node talks.
 *
 * While its code is farther than a threshold from the code at rest, or from the one that it sent
 * last (so a release is told, too); once in a heartbeat, at a turn of its own; and, during a roll
 * call, in its own frame and in no other. tactile_cdma/sim/nodes.py does the same.
 */
#ifndef TACTILE_EVENT_H
#define TACTILE_EVENT_H

#include <stdbool.h>
#include <stdint.h>

#include "tactile_protocol.h"

struct event {
    uint16_t threshold;
    uint16_t rest;
    uint16_t last_sent;
    uint16_t heartbeat;
    uint16_t to_heartbeat;   /* frames; 0: the next one */
    uint16_t turn;           /* frames of a roll call before this node's */
    uint16_t nodes;
    uint16_t called;         /* frames of a roll call that have begun; `nodes`: none is going on */
};

/* rest: code at rest, learnt or the record's. */
void event_init(struct event *e, const struct tp_node_record *record, uint16_t rest);

/* Whether the node talks in the next frame, if its code is `code` and no roll call begins. */
bool event_talks(const struct event *e, uint16_t code);

/* Whether it talks if a roll call does begin. */
static inline bool event_talks_first(const struct event *e)
{
    return e->turn == 0;
}

/* A frame has begun, heard or not, and with it a roll call, or not. spoke: whether this node says
 * `code` in it. */
void event_frame(struct event *e, bool call, bool spoke, uint16_t code);

#endif
