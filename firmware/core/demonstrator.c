// SPDX-License-Identifier: Apache-2.0

#include "demonstrator.h"

#include <string.h>

#include "frame.h"
#include "node_memory.h"
#include "setup.h"

#define ROWS 4
#define UNIT 256         /* parts of the distance of two taxels */
#define REACH_SHIFT 17   /* a touch reaches as far as √2¹⁷ parts: 1.4 taxels. Chosen */
#define RISE_FRAMES 32u  /* in which a touch gets its depth, and loses it: 0.4 s. Chosen */

/* A touch on the 4 × 4 taxels: deepest at a place that may move, and less all around. */
struct scene {
    int16_t x, y, x_speed; /* UNIT; UNIT per frame */
    uint16_t depth;        /* LSB */
    uint16_t frames;
};

/* In turn, unless the host asks for one of them, which then repeats. */
static const struct scene scenes[] = {
    [TP_SCENE_REST] = {.frames = 234},                                                   /* 3 s */
    [TP_SCENE_PRESS] = {.x = 384, .y = 384, .depth = 300, .frames = 234},                /* 30 kPa */
    [TP_SCENE_SLIDE] = {.x = -128, .y = 500, .x_speed = 4, .depth = 400, .frames = 256}, /* 4 taxels */
};
#define SCENES (sizeof scenes / sizeof *scenes)

static const struct node_limits limits = {
    .order = DEMO_ORDER,
    .chip_ns = 20000, /* chosen: a frame is planned in less time than it lasts */
    .scrambled_chip_ns = 20000,
    .longest_chip_ns = 1000000,
    .chip_step_ns = 1000,
    .measuring_us = 1000,
    .hears_own = true,
};

static const uint8_t *memory; /* of the node that is being loaded */

static uint8_t read_memory(uint16_t address)
{
    return memory[address];
}

bool demonstrator_init(struct demonstrator *d, const uint8_t *memories, uint16_t stride)
{
    memset(d, 0, sizeof *d);
    for (struct demo_node *node = d->nodes; node != d->nodes + DEMO_NODES; node++) {
        memory = memories;
        memories += stride;
        if (node_memory_load(&node->record, node->row, &limits, read_memory) != NODE_MEMORY_GOOD ||
            node->record.resync_chips || node->record.rest == TP_NODE_LEARN_REST)
            return false;
        event_init(&node->event, &node->record, node->record.rest);
        node->asked = node->record.rest;
    }
    const struct tp_node_record *record = &d->nodes[0].record;
    d->chip_count = frame_line_bits(record->bits, record->parity) * (uint32_t)record->order;
    d->scene = TP_SCENE_ALL;
    return true;
}

void demonstrator_begin(struct demonstrator *d, const struct setup *setup)
{
    d->setup = setup;
    d->ticks_per_chip = d->nodes[0].record.chip_ns / 1000u * setup->ticks_per_us;
    d->tick = setup->ticks_per_sample / 2;
    d->end = UINT64_MAX; /* known with the first pulse */
    d->chip = d->chip_count;
    d->level = 0;
    d->heard = d->planned = 0;
    d->words_asked = false;
}

void demonstrator_hear(struct demonstrator *d, const struct dg_pulse *pulse)
{
    if (pulse->units != TP_SYNC_FRAME) { /* no other digit comes before frames of these nodes */
        d->asked_frame = d->heard;
        d->words_asked = true;
        return;
    }
    d->heard++;
    if (d->end == UINT64_MAX)
        d->end = pulse->tick + TP_SYNC_LEAD * TP_SYNC_UNIT_US * d->setup->ticks_per_us;
}

/* How deep a touch is at a node, LSB. */
static uint16_t depth_at(const struct scene *scene, uint32_t frame, uint32_t node)
{
    uint32_t rise = frame < scene->frames - frame ? frame : scene->frames - frame;
    int32_t x = (int32_t)(node % ROWS * UNIT) - scene->x - scene->x_speed * (int32_t)frame;
    int32_t y = (int32_t)(node / ROWS * UNIT) - scene->y;
    int32_t inside = (1 << REACH_SHIFT) - x * x - y * y;

    if (inside <= 0)
        return 0;
    if (rise > RISE_FRAMES)
        rise = RISE_FRAMES;
    /* below 2¹⁰ · 2¹⁷ */
    return (uint16_t)((scene->depth * rise / RISE_FRAMES * (uint32_t)inside) >> REACH_SHIFT);
}

static void measure(struct demonstrator *d)
{
    uint32_t number = d->scene, frame = d->scene_frame++;

    if (number == TP_SCENE_ALL) {
        uint32_t all = scenes[0].frames;
        for (uint32_t i = 1; i < SCENES; i++)
            all += scenes[i].frames;
        frame %= all;
        for (number = 0; frame >= scenes[number].frames; number++)
            frame -= scenes[number].frames;
    } else if (number != TP_SCENE_HOST) {
        frame %= scenes[number].frames;
    }
    for (uint32_t i = 0; i < DEMO_NODES; i++) {
        struct demo_node *node = &d->nodes[i];
        node->code = number == TP_SCENE_HOST
                         ? node->asked
                         : (uint16_t)(node->record.rest - depth_at(&scenes[number], frame, i));
    }
}

static void add_chips(struct demonstrator *d, uint32_t number)
{
    const struct demo_node *node = &d->nodes[number];
    struct sequencer sequencer;

    sequencer_init(&sequencer, &node->record, node->row);
    sequencer_start(&sequencer, node->code);
    for (uint32_t chip = 0; chip < d->chip_count; chip++) {
        d->chips[chip] |= 0x10000u << number | (uint32_t)sequencer_level(&sequencer) << number;
        sequencer_step(&sequencer);
    }
}

void demonstrator_plan(struct demonstrator *d)
{
    /* A frame that is planned ahead of its pulse learns of it with the next. */
    bool all = d->words_asked && (int32_t)(d->planned - d->asked_frame) >= 0;

    if (all)
        d->words_asked = false;
    d->planned++;
    measure(d);
    memset(d->chips, 0, sizeof d->chips);
    for (uint32_t i = 0; i < DEMO_NODES; i++) {
        struct demo_node *node = &d->nodes[i];
        bool talks = all || event_talks(&node->event, node->code);
        if (talks)
            add_chips(d, i);
        event_frame(&node->event, false, talks, node->code);
    }
    d->chips[d->chip_count] = (uint16_t)d->chips[d->chip_count - 1];
}

enum tp_result demonstrator_touch(struct demonstrator *d, const struct tp_touch *touch)
{
    if (!tp_touch_in_range(touch) || touch->node > DEMO_NODES ||
        touch->code >> d->nodes[0].record.bits)
        return TP_RESULT_OUT_OF_RANGE;
    if (touch->scene != d->scene) {
        d->scene = touch->scene;
        d->scene_frame = 0;
        for (uint32_t i = 0; i < DEMO_NODES; i++)
            d->nodes[i].asked = d->nodes[i].record.rest;
    }
    for (uint32_t i = 0; i < DEMO_NODES; i++)
        if (touch->node == 0 || touch->node == i + 1)
            d->nodes[i].asked = touch->code;
    return TP_RESULT_OK;
}

/* Sum of the talking nodes' levels in a chip, ±1 each. */
static int32_t sum_of(uint32_t chip)
{
    int32_t sum = 0;

    for (uint32_t talks = chip >> 16; talks; talks >>= 1, chip >>= 1)
        if (talks & 1u)
            sum += chip & 1u ? 1 : -1;
    return sum;
}

/* Goes to the next chip: after the last one to the gap, after the gap to a frame. */
static void next_chip(struct demonstrator *d)
{
    if (d->chip == d->chip_count) {
        demonstrator_plan(d);
        d->chip = 0;
    } else {
        d->chip++;
    }
    d->end += d->chip < d->chip_count
                  ? d->ticks_per_chip
                  : d->setup->period_ticks - (uint64_t)d->chip_count * d->ticks_per_chip;
    d->level = DEMO_AMPLITUDE * sum_of(d->chips[d->chip]);
}

void demonstrator_line(struct demonstrator *d, uint16_t *counts, size_t size, uint16_t zero)
{
    for (size_t i = 0; i < size; i++) {
        while (d->tick >= d->end)
            next_chip(d);
        d->tick += d->setup->ticks_per_sample;
        if (counts)
            counts[i] = (uint16_t)(zero + d->level);
    }
}
