// SPDX-License-Identifier: Apache-2.0

/* Hears the frames of another digitizer, on its sync line: the edges of a pulse interrupt, and the timer, which
 * the converter's crystal also drives, tells when. The pin is pulled down: without a wire nothing is heard. */
#include "registers.h"
#include "rp2040.h"
#include "sync_pulse.h"

#define BOTH_EDGES (IO_BANK0_EDGE_LOW(PIN_HEARD) | IO_BANK0_EDGE_HIGH(PIN_HEARD))
#define LATER 0x40404040u

static struct dg *hearer;
static uint32_t risen_us;

void hear_init(struct dg *dg)
{
    hearer = dg;
    IO_BANK0->io[PIN_HEARD].ctrl = GPIO_FUNC_SIO;
    PADS_BANK0->io[PIN_HEARD] = PADS_BANK0_GPIO0_IE_BITS | PADS_BANK0_GPIO0_SCHMITT_BITS |
                                PADS_BANK0_GPIO0_PDE_BITS | PADS_BANK0_GPIO0_OD_BITS;
    IO_BANK0->intr[2] = BOTH_EDGES;
    IO_BANK0->proc0_inte[2] = BOTH_EDGES;
    /* Before all others: the two lines' pulses come at once, and making one would delay the other's time. */
    for (uint32_t i = 0; i < 8; i++)
        NVIC_IPR[i] = LATER;
    NVIC_IPR[IO_IRQ_BANK0 / 4] = LATER & ~(0xffu << 8 * (IO_IRQ_BANK0 % 4));
    NVIC_ISER = 1u << IO_IRQ_BANK0;
}

void hear_interrupt(void)
{
    uint32_t us = TIMER->timerawl, edges = IO_BANK0->intr[2] & BOTH_EDGES;

    IO_BANK0->intr[2] = edges;
    if (edges == IO_BANK0_EDGE_HIGH(PIN_HEARD))
        risen_us = us;
    else if (edges == IO_BANK0_EDGE_LOW(PIN_HEARD) && sync_pulse_units(us - risen_us, TP_SYNC_UNIT_US) == TP_SYNC_FRAME)
        dg_heard(hearer, risen_us + TP_SYNC_LEAD * TP_SYNC_UNIT_US);
}
