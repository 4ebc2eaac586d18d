// SPDX-License-Identifier: Apache-2.0

/* A demonstrator's nodes: sixteen sensing nodes without sensors, touched by scenes from a table or by
 * the host. Their memories, events and words are those of real nodes; only the code that a node would
 * measure comes from here, and a board puts out their chips. */
#ifndef TACTILE_DEMONSTRATOR_H
#define TACTILE_DEMONSTRATOR_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "event.h"
#include "pulses.h"
#include "sequencer.h"

#define DEMO_NODES 16u
#define DEMO_ORDER 64u                 /* longest row. Chosen: 16 nodes need 20 chips */
#define DEMO_CHIPS (11u * DEMO_ORDER)  /* most chips of a frame: 10 bits and parity */
#define DEMO_AMPLITUDE 19              /* counts of a node where the firmware adds the chips: 15.3 mV */

struct demo_node {
    struct tp_node_record record;
    uint8_t row[DEMO_ORDER / 8];
    struct event event;
    uint16_t code;  /* measured last, … */
    uint16_t asked; /* … and where the host touches it */
};

struct demonstrator {
    struct demo_node nodes[DEMO_NODES];
    uint32_t chip_count; /* chips of a frame */
    /* Chips of the present frame: levels of node n in bit n - 1, its direction (1: it talks) 16 bits
     * above. After the last one all nodes release the line, whose levels stay until they have. */
    uint32_t chips[DEMO_CHIPS + 1];
    uint8_t scene;       /* enum tp_scene */
    uint32_t scene_frame; /* frames since it began */

    uint32_t heard, planned; /* frames' pulses and frames since the stream began */
    uint32_t asked_frame;    /* from this one on … */
    volatile bool words_asked; /* … all nodes are still to speak */

    /* of demonstrator_line: */
    const struct setup *setup;
    uint32_t ticks_per_chip;
    uint64_t tick;  /* of the stream, when the next sample is taken, … */
    uint64_t end;   /* … and where the present chip ends, or the gap before a frame */
    uint32_t chip;  /* the present one; chip_count: the gap */
    int32_t level;  /* of the line, counts */
};

/* Loads the nodes' memories, each `stride` bytes, one after another. False if one of them is not as a
 * node takes it, or has restarts within the frame, which these nodes do not make. */
bool demonstrator_init(struct demonstrator *d, const uint8_t *memories, uint16_t stride);

/* A stream begins: no pulse has come, no frame is planned. The scene goes on. */
void demonstrator_begin(struct demonstrator *d, const struct setup *setup);

/* Takes note of a pulse on the sync line, before it is made; may be called from an interrupt. */
void demonstrator_hear(struct demonstrator *d, const struct dg_pulse *pulse);

/* Plans the next frame: measures, decides who talks, and fills `chips`. */
void demonstrator_plan(struct demonstrator *d);

/* Executes TOUCH. */
enum tp_result demonstrator_touch(struct demonstrator *d, const struct tp_touch *touch);

/* The next samples of a line on which these nodes' chips are added, in counts about `zero`: overwrites
 * counts; NULL: they were lost. Plans frames by itself. */
void demonstrator_line(struct demonstrator *d, uint16_t *counts, size_t size, uint16_t zero);

#endif
