// SPDX-License-Identifier: Apache-2.0

/* What test_demo.py needs of the demonstrator's nodes, as functions of plain numbers and arrays. */
#include "../../firmware/digitizer/rp2040/demo/memories.h"
#include "demonstrator.h"

static struct demonstrator demo;
static struct setup setup;

/* Powers up and begins a stream; returns the chips of a frame, 0 if a memory was refused. `damaged`: a byte
 * of the memories that is changed; negative: none. */
uint32_t shim_demo_begin(int32_t damaged)
{
    static const struct dg_board board = {{0}, 48, 96, 65536, 0x1p-10f, 2048, 0, 4095, 0, 0, false, false};
    static uint8_t memories[sizeof demo_memories];

    for (size_t i = 0; i < sizeof memories; i++)
        memories[i] = (uint8_t)(demo_memories[i] ^ ((int32_t)i == damaged));
    if (!setup_make(&setup, &board, &setup_default) ||
        !demonstrator_init(&demo, memories, DEMO_MEMORY_SIZE))
        return 0;
    demonstrator_begin(&demo, &setup);
    return demo.chip_count;
}

/* A pulse that asks all nodes to speak. */
void shim_demo_ask(void)
{
    struct dg_pulse pulse = {.units = TP_SYNC_RESTART};

    demonstrator_hear(&demo, &pulse);
}

/* A frame's pulse, which may come a frame before it is planned. */
void shim_demo_pulse(void)
{
    struct dg_pulse pulse = {.units = TP_SYNC_FRAME};

    demonstrator_hear(&demo, &pulse);
}

/* The next frame: copies its chips and the release after them. */
void shim_demo_frame(uint32_t *chips)
{
    demonstrator_plan(&demo);
    for (uint32_t i = 0; i <= demo.chip_count; i++)
        chips[i] = demo.chips[i];
}

int shim_demo_touch(uint8_t scene, uint16_t node, uint16_t code)
{
    struct tp_touch touch = {.scene = scene, .node = node, .code = code};

    return demonstrator_touch(&demo, &touch);
}
