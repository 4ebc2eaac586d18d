// SPDX-License-Identifier: Apache-2.0

/* The digitizer on an RP2040: supplies to the portable core what core/board.h declares. */
#include "loop.h"
#include "nodes.h"
#include "registers.h"
#include "rp2040.h"

#define TICK_IDLE_US 10000u     /* chosen: the reports of each second come within 1 % of it */
#define TICK_STREAMING_US 250u  /* 125 samples at 500 kS/s: half of DG_CHUNK */
/* Chosen: two packets, so that a silent frame of 1,500 nodes can be held until it is over. */
#define SAMPLE_CAPACITY (2 * TP_MAX_SAMPLES)
/* Bytes. Chosen: a slow host may fall 98 ms behind a stream of 1 MB/s. */
#define OUTPUT_SIZE 98304u

_Static_assert(OUTPUT_SIZE >= DG_OUTPUT_MIN(TP_MAX_SAMPLES), "output ring too small");

static enum tp_result obey(uint8_t type, const uint8_t *payload, size_t size)
{
    if (type != TP_BOOTSEL)
        return nodes_obey(type, payload, size);
    if (size)
        return TP_RESULT_BAD_LENGTH;
    bootsel_ask();
    return TP_RESULT_OK;
}

static struct dg_board board = {
    .ticks_per_us = TICKS_PER_US,
    .min_ticks = SAMPLER_MIN_TICKS,
    .max_ticks = SAMPLER_MAX_TICKS,
    .volts_per_count = 3.3f / 4096,
    .zero_count = 2048, /* the amplifier rests at half the supply */
    .min_count = 0,
    .max_count = 4095,
    .command = obey,
    .hears = true,
};
static struct dg dg;
static uint8_t output[OUTPUT_SIZE];
static int16_t samples[SAMPLE_CAPACITY];
static volatile bool awake;

void wake(void)
{
    awake = true;
}

static void sleep(void)
{
    interrupts_off();
    if (!awake)
        __asm__ volatile("wfi");
    interrupts_on();
    awake = false;
}

static void restart(struct dg *dg)
{
    sync_stop();
    sampler_stop();
    nodes_stop();
    tick_every(dg->running ? TICK_STREAMING_US : TICK_IDLE_US);
    if (!dg->running) {
        SIO->gpio_clr = 1u << PIN_LED;
        return;
    }
    struct moment moment;
    nodes_begin(dg);
    sync_prepare();
    uint32_t begin = sampler_start(dg->ticks_per_sample, &moment);
    dg_begin(dg, moment.us - (moment.tick + TICKS_PER_US / 2) / TICKS_PER_US);
    sync_start(dg, begin, &moment);
    SIO->gpio_set = 1u << PIN_LED;
}

static struct dg_hardware hardware = {
    .time_us = time_us,
    .sleep = sleep,
    .links = nodes_links,
    .restart = restart,
    .take_samples = nodes_take,
    .release_samples = sampler_done,
    .pause_samples = sampler_pause,
    .pulses_failed = nodes_failed,
};

int main(void)
{
    static struct dg_loop loop;

    clocks_init();
    SIO->gpio_oe_set = 1u << PIN_LED;
    IO_BANK0->io[PIN_LED].ctrl = GPIO_FUNC_SIO;
    PADS_BANK0->io[PIN_LED] = PAD_DRIVE_4MA;
    flash_id(board.id);
    sampler_init();
    sync_stop();
    nodes_init(&board);
    hardware.link_count = nodes_link_count;
    usb_init(board.id, nodes_current_ma());
    dg_init(&dg, &board, output, sizeof output, samples, SAMPLE_CAPACITY, time_us());
    hear_init(&dg);
    dg_loop_init(&loop, &dg, &hardware);
    tick_every(TICK_IDLE_US);

    for (;;) {
        watchdog_feed();
        bootsel_when_asked();
        dg_loop_pass(&loop);
    }
}
