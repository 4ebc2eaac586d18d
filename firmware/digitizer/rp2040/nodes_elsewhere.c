// SPDX-License-Identifier: Apache-2.0

/* A digitizer: its nodes are elsewhere, on the line and the sync line. */
#include "nodes.h"
#include "registers.h"
#include "rp2040.h"

#define PULL_UP_US 10u /* chosen: a hundred times what 80 kΩ take to charge a pin and a track */

const char nodes_product[] = "Tactile skin digitizer";
const struct dg_link nodes_links[] = {
    {usb_ready, usb_read, usb_send, usb_sending, usb_cancel},
    {uart_ready, uart_read, uart_send, uart_sending, uart_cancel},
};
const size_t nodes_link_count = sizeof nodes_links / sizeof *nodes_links;

void nodes_init(struct dg_board *board)
{
    (void)board;
    PADS_BANK0->io[PIN_FEEDS] = PADS_BANK0_GPIO0_IE_BITS | PADS_BANK0_GPIO0_PUE_BITS | PADS_BANK0_GPIO0_OD_BITS;
    uart_init();
    uint64_t then = time_us();
    while (time_us() - then < PULL_UP_US)
        ;
}

/* A board that feeds strips says so by a pin tied to ground. A bare one takes what every hub gives. */
uint32_t nodes_current_ma(void)
{
    return SIO->gpio_in & 1u << PIN_FEEDS ? 100 : 500;
}

void nodes_stop(void)
{
}

void nodes_begin(struct dg *dg)
{
    (void)dg;
}

bool nodes_pulse(struct dg *dg, struct dg_pulse *pulse)
{
    return dg_pulse(dg, pulse);
}

size_t nodes_take(const uint16_t **samples, uint32_t *lost)
{
    return sampler_take(samples, lost);
}

bool nodes_failed(void)
{
    return sync_failed();
}

enum tp_result nodes_obey(uint8_t type, const uint8_t *payload, size_t size)
{
    (void)type;
    (void)payload;
    (void)size;
    return TP_RESULT_UNKNOWN_COMMAND;
}
