// SPDX-License-Identifier: Apache-2.0

/* Decides in which frames a node transmits.
 *
 * It transmits while its code differs by more than a threshold from the code last sent, and once per
 * heartbeat at a turn of its own. By the rule `rest` (record->follow is not 0), it also does while its code
 * differs from that at rest, which follows drift but no touch: hardware/node_memory.py derives how fast. In the
 * turn of another group it keeps all that.
 * tactile_cdma/sim/nodes.py has the same rules.
 */
#ifndef TACTILE_EVENT_H
#define TACTILE_EVENT_H

#include <stdbool.h>
#include <stdint.h>

#include "tactile_protocol.h"

struct event {
    const struct tp_node_record *record;
    uint16_t rest;
    uint16_t last_sent;
    uint16_t to_heartbeat;   /* frames to the next heartbeat; 0: the next frame */
    uint16_t to_step;        /* frames to the next step of the rest */
    uint16_t steps;          /* of these so far */
    bool owes;               /* a heartbeat that fell into another group's turn */
};

/* Whether codes differ by more than this. */
static inline bool event_farther(uint16_t a, uint16_t b, uint16_t distance)
{
    return (a > b ? a - b : b - a) > distance;
}

/* rest: code at rest, learnt or from the record, which stays in use. */
void event_init(struct event *e, const struct tp_node_record *record, uint16_t rest);

/* Whether the node transmits in the next frame, given its code. */
bool event_talks(const struct event *e, uint16_t code);

/* Counts a frame, whether or not its pulse was heard. others: it is another group's turn. spoke: this node
 * transmits `code` in it. */
void event_frame(struct event *e, bool others, bool spoke, uint16_t code);

#endif
