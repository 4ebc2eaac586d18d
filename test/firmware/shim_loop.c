// SPDX-License-Identifier: Apache-2.0

/* A board in memory for core/loop.c: two links, samples and pulses as the test sets them. */
#include <stdlib.h>
#include <string.h>

#include "loop.h"

#define LINKS 2
#define ROOM (1 << 20)

static const struct dg_board description = {
    .id = "loop",
    .ticks_per_us = 48,
    .min_ticks = 96,
    .max_ticks = 65536,
    .volts_per_count = 1e-3f,
    .max_count = 4095,
};

static struct {
    uint64_t now_us;
    size_t sleeps, starts;
    bool ready[LINKS], pulses_failed, paused;
    uint8_t to_read[LINKS][1024], sent[LINKS][ROOM];
    size_t to_read_size[LINKS], sent_size[LINKS];
    const uint8_t *sending[LINKS];
    size_t sending_left[LINKS];
    uint16_t counts[4096];
    size_t first, waiting, lost;
} hw;

static struct dg dg;
static struct dg_loop loop;
static uint8_t output[65536];
static int16_t words[TP_MAX_SAMPLES];

static uint64_t time_us(void)
{
    return hw.now_us;
}

static void sleep_until_woken(void)
{
    hw.sleeps++;
}

static size_t read_link(int link, uint8_t *bytes, size_t size)
{
    if (size > hw.to_read_size[link])
        size = hw.to_read_size[link];
    memcpy(bytes, hw.to_read[link], size);
    hw.to_read_size[link] -= size;
    memmove(hw.to_read[link], hw.to_read[link] + size, hw.to_read_size[link]);
    return size;
}

static size_t cancel_link(int link)
{
    size_t left = hw.sending_left[link];

    hw.sending_left[link] = 0;
    return left;
}

#define LINK(n)                                                                                \
    static bool ready_##n(void) { return hw.ready[n]; }                                        \
    static size_t read_##n(uint8_t *bytes, size_t size) { return read_link(n, bytes, size); }  \
    static void send_##n(const uint8_t *bytes, size_t size)                                    \
    {                                                                                          \
        hw.sending[n] = bytes;                                                                 \
        hw.sending_left[n] = size;                                                             \
    }                                                                                          \
    static bool sending_##n(void) { return hw.sending_left[n] != 0; }                          \
    static size_t cancel_##n(void) { return cancel_link(n); }
LINK(0)
LINK(1)

static void restart(struct dg *dg)
{
    hw.starts++;
    hw.paused = hw.pulses_failed = false;
    if (dg->running)
        dg_begin(dg, hw.now_us);
}

static size_t take_samples(const uint16_t **counts, uint32_t *lost)
{
    *lost = (uint32_t)hw.lost;
    hw.lost = 0;
    *counts = hw.counts + hw.first;
    return hw.waiting < DG_CHUNK ? hw.waiting : DG_CHUNK;
}

static void release_samples(size_t size)
{
    hw.first += size;
    hw.waiting -= size;
}

static void pause_samples(void)
{
    hw.paused = true;
}

static bool pulses_failed(void)
{
    return hw.pulses_failed;
}

static const struct dg_link links[LINKS] = {
    {ready_0, read_0, send_0, sending_0, cancel_0},
    {ready_1, read_1, send_1, sending_1, cancel_1},
};

static const struct dg_hardware hardware = {
    time_us, sleep_until_woken, links, LINKS, restart,
    take_samples, release_samples, pause_samples, pulses_failed,
};

void loop_new(void)
{
    memset(&hw, 0, sizeof hw);
    hw.ready[1] = true;
    dg_init(&dg, &description, output, sizeof output, words, TP_MAX_SAMPLES, 0);
    dg_loop_init(&loop, &dg, &hardware);
}

void loop_pass(uint64_t now_us)
{
    hw.now_us = now_us;
    dg_loop_pass(&loop);
}

void loop_ready(int link, bool ready)
{
    hw.ready[link] = ready;
}

void loop_write(int link, const uint8_t *bytes, size_t size)
{
    memcpy(hw.to_read[link] + hw.to_read_size[link], bytes, size);
    hw.to_read_size[link] += size;
}

/* A link carries up to `most` bytes of what it sends. */
void loop_carry(int link, size_t most)
{
    size_t size = hw.sending_left[link] < most ? hw.sending_left[link] : most;

    if (!size)
        return;
    memcpy(hw.sent[link] + hw.sent_size[link], hw.sending[link], size);
    hw.sent_size[link] += size;
    hw.sending[link] += size;
    hw.sending_left[link] -= size;
}

size_t loop_sent(int link, const uint8_t **bytes)
{
    *bytes = hw.sent[link];
    return hw.sent_size[link];
}

void loop_sample(size_t size, size_t lost)
{
    hw.first = 0;
    hw.waiting = size;
    hw.lost = lost;
}

void loop_fail_pulses(void)
{
    hw.pulses_failed = true;
}

size_t loop_sleeps(void)
{
    return hw.sleeps;
}

size_t loop_starts(void)
{
    return hw.starts;
}
