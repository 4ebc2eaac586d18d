// SPDX-License-Identifier: Apache-2.0

/* Clocks, watchdog and time.
 *
 * clk_sys is 96 MHz, not the usual 125 MHz, so that the PWM with an integer divider counts the same
 * 48 MHz as the ADC. Sync pulses then fall exactly on ticks of the sampling clock.
 */
#include "registers.h"
#include "rp2040.h"

#define CRYSTAL_MHZ 12u
#define WATCHDOG_US 500000u /* chosen: half of the time after which sampler.c loses its place */

static volatile uint32_t tick_us;

static void pll_start(volatile struct pll *pll, uint32_t reset, uint32_t fbdiv_int, uint32_t prim)
{
    reset_blocks(reset);
    pll->cs = 1; /* reference: the crystal */
    pll->fbdiv_int = fbdiv_int;
    clear_bits(&pll->pwr, PLL_PWR_PD_BITS | PLL_PWR_VCOPD_BITS);
    while (!(pll->cs & PLL_CS_LOCK_BITS))
        ;
    pll->prim = prim;
    clear_bits(&pll->pwr, PLL_PWR_POSTDIVPD_BITS);
}

void clocks_init(void)
{
    /* · 256 periods of 12 MHz = 64 ms: 64 times the data sheet's 1 ms, for slow crystals */
    XOSC->startup = 64 * 47;
    XOSC->ctrl = XOSC_ENABLE_1_15MHZ;
    while (!(XOSC->status & XOSC_STATUS_STABLE_BITS))
        ;
    CLK_REF->ctrl = CLK_REF_XOSC;
    while (!(CLK_REF->selected & 1u << CLK_REF_XOSC))
        ;
    CLK_SYS->ctrl = 0; /* clk_ref while the PLL is set up */
    while (!(CLK_SYS->selected & 1u))
        ;
    pll_start(PLL_SYS, RESETS_RESET_PLL_SYS_BITS, 120, PLL_PRIM(5, 3)); /* 1440 MHz / 15 = 96 MHz */
    pll_start(PLL_USB, RESETS_RESET_PLL_USB_BITS, 100, PLL_PRIM(5, 5)); /* 1200 MHz / 25 = 48 MHz */
    CLK_SYS->div = CLK_DIV_1;
    CLK_SYS->ctrl = CLK_SYS_AUX;
    while (!(CLK_SYS->selected & 1u << CLK_SYS_AUX))
        ;
    CLK_PERI->ctrl = CLK_ENABLE; /* clk_sys */
    CLK_USB->div = CLK_DIV_1;
    CLK_USB->ctrl = CLK_ENABLE; /* PLL_USB, and so … */
    CLK_ADC->div = CLK_DIV_1;
    CLK_ADC->ctrl = CLK_ENABLE; /* … here */

    reset_blocks(RESETS_RESET_TIMER_BITS | RESETS_RESET_IO_BANK0_BITS | RESETS_RESET_PADS_BANK0_BITS |
                 RESETS_RESET_DMA_BITS);
    WATCHDOG->tick = CRYSTAL_MHZ | WATCHDOG_TICK_ENABLE_BITS; /* 1 µs; also the timer's tick */
    PSM->wdsel = PSM_ALL_BUT_OSCILLATORS; /* blocks that the watchdog resets */
    watchdog_feed();
    WATCHDOG->ctrl = WATCHDOG_CTRL_ENABLE_BITS | WATCHDOG_PAUSE_DEBUG;

    TIMER->inte = 1;
    NVIC_ISER = 1u << TIMER_IRQ_0;
}

void watchdog_feed(void)
{
    WATCHDOG->load = 2 * WATCHDOG_US; /* it counts down twice per tick (erratum E1) */
}

uint64_t time_us(void)
{
    for (;;) {
        uint32_t high = TIMER->timerawh, low = TIMER->timerawl;
        if (high == TIMER->timerawh)
            return (uint64_t)high << 32 | low;
    }
}

void tick_every(uint32_t us)
{
    tick_us = us;
    TIMER->alarm[0] = TIMER->timerawl + us;
}

void tick_interrupt(void)
{
    TIMER->intr = 1;
    TIMER->alarm[0] = TIMER->timerawl + tick_us;
    wake();
}
