// SPDX-License-Identifier: Apache-2.0

/* Decides in which frames a node transmits.
 *
 * It transmits while its code differs by more than a threshold from the code at rest or from the
 * code last sent (so that a release is reported too), once per heartbeat at a turn of its own, and,
 * during a roll call, in its own frame only. In the turn of another group it keeps all that.
 * tactile_cdma/sim/nodes.py has the same rules.
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
    uint16_t to_heartbeat;   /* frames to the next heartbeat; 0: the next frame */
    bool owes;               /* a heartbeat that fell into another group's turn */
    uint16_t turn;           /* frames of a roll call before this node's own */
    uint16_t nodes;
    uint16_t called;         /* frames of the roll call begun so far; `nodes`: no roll call */
};

/* Whether codes differ by more than this. */
static inline bool event_farther(uint16_t a, uint16_t b, uint16_t distance)
{
    return (a > b ? a - b : b - a) > distance;
}

/* rest: code at rest, learnt or from the record. */
void event_init(struct event *e, const struct tp_node_record *record, uint16_t rest);

/* Whether the node transmits in the next frame, given its code and that no roll call begins. */
bool event_talks(const struct event *e, uint16_t code);

/* Whether it transmits in a frame that begins a roll call. */
static inline bool event_talks_first(const struct event *e)
{
    return e->turn == 0;
}

/* Counts a frame, whether or not its pulse was heard. call: it begins a roll call. others: it is another
 * group's turn. spoke: this node transmits `code` in it. */
void event_frame(struct event *e, bool call, bool others, bool spoke, uint16_t code);

#endif
