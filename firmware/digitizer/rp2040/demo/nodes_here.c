// SPDX-License-Identifier: Apache-2.0

/* A demonstrator: its nodes are here. Either they have a pin each, joined by resistors on the line that
 * the converter samples; or, where nothing is wired, the samples are replaced by the sum of their chips.
 */
#include "nodes.h"

#include <string.h>

#include "demonstrator.h"
#include "memories.h"
#include "pins.h"
#include "rp2040.h"

const char nodes_product[] = "Tactile skin demonstrator";
/* The UART's pins are nodes. What is sent before a host has configured the device is lost. */
const struct dg_link nodes_links[] = {{usb_ready, usb_read, usb_send, usb_sending, usb_cancel}};
const size_t nodes_link_count = 1;

static struct demonstrator demo;
static bool wired;
static uint16_t rest; /* of the line, counts */

/* Loads the nodes, finds out whether they are wired, and says so in the board's id. */
void nodes_init(struct dg_board *board)
{
    uint16_t kind;

    if (!demonstrator_init(&demo, demo_memories, DEMO_MEMORY_SIZE))
        for (;;) /* a wrong build: the watchdog resets it for ever */
            ;
    pins_init();
    wired = pins_are_wired();
    rest = (uint16_t)board->zero_count;
    kind = wired ? TP_DEMO_WIRED : TP_DEMO_WIRELESS;
    memcpy(board->id + 4, board->id + 6, 2);
    memcpy(board->id, TP_SIMULATED_ID, 4);
    memcpy(board->id + 6, &kind, sizeof kind);
    board->layout = &setup_default.frame;
    board->wireless = !wired;
}

uint32_t nodes_current_ma(void)
{
    return 100;
}

/* Frames are planned ahead of their pulses, from what sync.c has asked for by then. */
static void play_next(void)
{
    demonstrator_plan(&demo);
    pins_play(demo.chips, demo.chip_count + 1);
}

void nodes_stop(void)
{
    pins_stop();
}

void nodes_begin(struct dg *dg)
{
    demonstrator_begin(&demo, &dg->setup);
    if (!wired)
        return;
    pins_start(demo.nodes[0].record.chip_ns / 1000u);
    play_next();
}

/* Digits are heard here, and not put on the line: the pins' state machine takes any pulse for a frame's. */
bool nodes_pulse(struct dg *dg, struct dg_pulse *pulse)
{
    do {
        if (!dg_pulse(dg, pulse))
            return false;
        demonstrator_hear(&demo, pulse);
    } while (pulse->units != TP_SYNC_FRAME);
    return true;
}

size_t nodes_take(const uint16_t **samples, uint32_t *lost)
{
    size_t size = sampler_take(samples, lost);

    if (wired) {
        if (pins_want_frame())
            play_next();
    } else {
        demonstrator_line(&demo, NULL, *lost, rest);
        demonstrator_line(&demo, (uint16_t *)*samples, size, rest); /* in the sampler's memory */
    }
    return size;
}

bool nodes_failed(void)
{
    return sync_failed() || (wired && pins_failed());
}

enum tp_result nodes_obey(uint8_t type, const uint8_t *payload, size_t size)
{
    struct tp_touch touch;

    if (type != TP_TOUCH)
        return TP_RESULT_UNKNOWN_COMMAND;
    if (size != sizeof touch)
        return TP_RESULT_BAD_LENGTH;
    memcpy(&touch, payload, sizeof touch);
    return demonstrator_touch(&demo, &touch);
}
