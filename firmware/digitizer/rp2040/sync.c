// SPDX-License-Identifier: Apache-2.0

/* Makes the sync pulses by PWM slice 0: each of its periods is an interval of the sync line that may
 * begin with a pulse. It counts the ADC's ticks and loads the next period's length and pulse when one
 * ends, so an interrupt has a whole period to program the next, and its latency does not delay the
 * pulses. Long intervals consist of several periods.
 */
#include "nodes.h"
#include "registers.h"
#include "rp2040.h"

#define SYS_PER_TICK 2u
#define FIRST_TICKS 6000u /* first period, 125 µs; the first pulse comes 168 µs or more after tick 0 */
#define MAX_TICKS 65536u  /* longest period: 16 bits */
#define SPARE_TICKS (2 * TICKS_PER_US) /* 2 µs: the time is known to 1 µs */
#define SLICE_0 1u

static struct dg *source;
static struct moment begin;
static struct dg_pulse pulse; /* the next pulse not yet programmed */
static bool pulse_left;
static uint64_t running_end, programmed_end; /* ticks: ends of the running and programmed periods */
static volatile bool failed;

/* Sets the line low and resets the slice, which then counts from 0. */
void sync_stop(void)
{
    IO_BANK0->io[PIN_SYNC].ctrl = GPIO_FUNC_SIO;
    SIO->gpio_clr = 1u << PIN_SYNC;
    SIO->gpio_oe_set = 1u << PIN_SYNC;
    PADS_BANK0->io[PIN_SYNC] = PAD_DRIVE_4MA | PADS_BANK0_GPIO0_SCHMITT_BITS | PADS_BANK0_GPIO0_IE_BITS;
    reset_blocks(RESETS_RESET_PWM_BITS);
}

void sync_prepare(void)
{
    sync_stop();
    PWM->slice[0].div = PWM_DIV(SYS_PER_TICK);
    PWM->slice[0].top = FIRST_TICKS - 1;
    PWM->slice[0].cc = 0;
    IO_BANK0->io[PIN_SYNC].ctrl = GPIO_FUNC_PWM;
}

/* Programs the period after the programmed one. */
static void program_next(void)
{
    uint32_t high = 0;
    uint64_t left = MAX_TICKS; /* ticks to the next pulse */

    if (pulse_left && pulse.tick == programmed_end) {
        high = pulse.units * TP_SYNC_UNIT_US * TICKS_PER_US;
        pulse_left = nodes_pulse(source, &pulse);
    }
    if (pulse_left)
        left = pulse.tick - programmed_end;
    uint32_t length = (uint32_t)(left > 2 * MAX_TICKS ? MAX_TICKS : left);
    if (length > MAX_TICKS)
        length /= 2; /* two equal periods: the last is never short */
    PWM->slice[0].cc = high;
    PWM->slice[0].top = length - 1;
    running_end = programmed_end;
    programmed_end += length;

    /* modulo 2³²: the difference is right */
    uint32_t now = begin.tick + (TIMER->timerawl - (uint32_t)begin.us) * TICKS_PER_US;
    if ((int32_t)((uint32_t)running_end - now) < (int32_t)SPARE_TICKS) {
        failed = true;
        sync_stop();
    }
}

void sync_start(struct dg *dg, uint32_t begin_tick, const struct moment *moment)
{
    failed = false;
    source = dg;
    begin = *moment;
    programmed_end = begin_tick + FIRST_TICKS;
    pulse_left = nodes_pulse(dg, &pulse);
    if (!pulse_left)
        return;
    program_next();
    PWM->inte = SLICE_0;
    NVIC_ISER = 1u << PWM_IRQ_WRAP;
}

bool sync_failed(void)
{
    return failed;
}

void sync_interrupt(void)
{
    PWM->intr = SLICE_0;
    program_next();
    if (failed)
        wake();
}
