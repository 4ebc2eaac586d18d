// SPDX-License-Identifier: Apache-2.0

/* A demonstrator under TOUCH of any content and losses of samples: every word on its chips is the code of
 * its node, in whole rows of that node; the line is the sum of the chips, wherever samples are cut; a
 * touch that is refused changes nothing. */
#include "demonstrator.h"

#include "../digitizer/rp2040/demo/memories.h"
#include "fuzz.h"
#include "reference.h"
#include "setup.h"

#define MOST_STEPS 64

static struct demonstrator demo, alike; /* `alike` hears the same and is cut otherwise */
static struct setup setup;
static uint64_t period, mark; /* ticks */
static uint16_t host_code[DEMO_NODES]; /* as touched; UINT16_MAX: at rest */

/* The code that a node's chips spell; a chip that is of no whole row is a fault. */
static uint16_t spelt(uint32_t number)
{
    const struct demo_node *node = &demo.nodes[number];
    uint16_t order = node->record.order, code = 0;
    uint32_t state = node->record.scramble;

    MUST(state != 0, WRONG_VALUE);
    for (uint32_t bit = 0; bit < node->record.bits; bit++) {
        uint32_t right = 0;
        for (uint32_t k = 0; k < order; k++) {
            uint32_t place = k + (-order & 7u); /* the last chip of a row ends an octet */
            uint32_t chip = node->row[place / 8] >> place % 8 & 1u;
            if (k == 0 || place % 8 == 0)
                state = scrambled(state);
            chip ^= (node->record.sign < 0) ^ (state >> 24 >> place % 8 & 1u);
            right += chip == (demo.chips[bit * order + k] >> number & 1u);
        }
        MUST(right == 0 || right == order, WRONG_VALUE);
        code = (uint16_t)(code << 1 | (right == order));
    }
    return code;
}

static void check_frame(void)
{
    uint32_t talks = demo.chips[0] >> 16;

    for (uint32_t chip = 0; chip < demo.chip_count; chip++)
        MUST(demo.chips[chip] >> 16 == talks, WRONG_VALUE);
    MUST(demo.chips[demo.chip_count] >> 16 == 0, WRONG_VALUE);
    for (uint32_t i = 0; i < DEMO_NODES; i++) {
        uint16_t wanted = demo.nodes[i].record.rest;
        if (demo.scene == TP_SCENE_HOST && host_code[i] != UINT16_MAX)
            wanted = host_code[i];
        if (!(talks >> i & 1u))
            continue;
        MUST(spelt(i) == demo.nodes[i].code, WRONG_VALUE);
        if (demo.scene == TP_SCENE_HOST || demo.scene == TP_SCENE_REST)
            MUST(spelt(i) == wanted, WRONG_VALUE);
    }
}

static void touch(struct input *input)
{
    struct tp_touch asked = {.scene = input_u8(input) % 7};
    uint8_t before = demo.scene;

    asked.node = input_u8(input) % 20;
    asked.code = input_u16(input) & 0x47ff;
    bool good = asked.scene <= TP_SCENE_ALL && asked.node <= DEMO_NODES && asked.code <= 1023;

    MUST((demonstrator_touch(&demo, &asked) == TP_RESULT_OK) == good, WRONG_VALUE);
    MUST((demonstrator_touch(&alike, &asked) == TP_RESULT_OK) == good, WRONG_VALUE);
    MUST(demo.scene == (good ? asked.scene : before), WRONG_VALUE);
    for (uint32_t i = 0; good && i < DEMO_NODES; i++) {
        if (before != asked.scene)
            host_code[i] = UINT16_MAX;
        if (asked.node == 0 || asked.node == i + 1)
            host_code[i] = asked.code;
    }
}

/* A frame period of samples in pieces, some of them lost; of `alike` all of them at once. */
static void sample(struct input *input)
{
    static uint16_t counts[4096], whole[4096];
    size_t size = (size_t)(period / setup.ticks_per_sample), done = 0;

    demonstrator_line(&alike, whole, size, 2048);
    while (done < size) {
        size_t piece = 1 + input_u16(input) % (size - done);
        bool lost = input_u8(input) > 0xE0;
        demonstrator_line(&demo, lost ? NULL : counts + done, piece, 2048);
        MUST(lost || !memcmp(counts + done, whole + done, piece * sizeof *counts), WRONG_VALUE);
        done += piece;
    }
    check_frame();
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    static const struct dg_board board = {
        .ticks_per_us = 48, .min_ticks = 96, .max_ticks = 65536, .volts_per_count = 0x1p-10f};
    struct input input = {bytes, size};

    MUST(setup_make(&setup, &board, &setup_default), WRONG_VALUE);
    MUST(demonstrator_init(&demo, demo_memories, DEMO_MEMORY_SIZE), WRONG_VALUE);
    alike = demo;
    memset(host_code, 0xff, sizeof host_code);
    demonstrator_begin(&demo, &setup);
    demonstrator_begin(&alike, &setup);
    period = setup.period_ticks;
    mark = setup.first_mark;
    for (int step = 0; input.left && step < MOST_STEPS; step++) {
        uint8_t action = input_u8(&input);
        struct dg_pulse pulse = {
            mark - TP_SYNC_LEAD * TP_SYNC_UNIT_US * setup.ticks_per_us,
            TP_SYNC_FRAME,
        };
        for (int n = action & 3; n; n--)
            touch(&input);
        struct dg_pulse ask = {pulse.tick, TP_SYNC_RESTART};
        if (action & 0x80) {
            demonstrator_hear(&demo, &ask);
            demonstrator_hear(&alike, &ask);
        }
        demonstrator_hear(&demo, &pulse);
        demonstrator_hear(&alike, &pulse);
        sample(&input);
        MUST(!(action & 0x80) || demo.chips[0] >> 16 == 0xFFFF, WRONG_VALUE);
        mark += period;
    }
    return 0;
}
