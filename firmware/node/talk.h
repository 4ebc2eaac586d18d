// Copyright 2026 tactile_cdma maintainers
//
// Licensed under the Apache License, Version 2.0 (the "License");
// you may not use this file except in compliance with the License.
// You may obtain a copy of the License at
//
//     http://www.apache.org/licenses/LICENSE-2.0
//
// Unless required by applicable law or agreed to in writing, software
// distributed under the License is distributed on an "AS IS" BASIS,
// WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
// See the License for the specific language governing permissions and
// limitations under the License.

/* Talking: what a node does in interrupts, from the edges of the sync line to those of its own.
 *
 * main.c makes a plan for every frame before it begins. Whether a pulse begins it is told here when
 * the pulse ends, a few µs before the first chip: only levels and times are left to be done then.
 */
#ifndef NODE_TALK_H
#define NODE_TALK_H

#include <stdbool.h>
#include <stdint.h>

#include "discipline.h"
#include "tactile_protocol.h"

struct talk_frame {
    uint32_t when;   /* its pulse began */
    uint8_t units;   /* the pulse's length: TP_SYNC_FRAME or TP_SYNC_CALL */
    bool spoke;      /* whether the plan's code is said in it */
};

/* A frame has begun that talk_take has not been asked about: not 0. */
extern volatile uint8_t talk_began;

void talk_init(const struct tp_node_record *record, const uint8_t *row);

/* For the next frame: what to say, and whether, in an ordinary frame and in a roll call's first.
 * The line must have been released by talk_stop. */
void talk_plan(const struct discipline *clock, uint16_t code, bool talks, bool talks_first);

/* Releases the line, and forgets the plan. */
void talk_stop(void);

/* The frame that has begun. */
struct talk_frame talk_take(void);

#endif
