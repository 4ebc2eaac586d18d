// SPDX-License-Identifier: Apache-2.0

/* The emulated skin's digitizer without nodes: a host sends and reads bytes at any time, over a link of
 * any speed. */
#include "virtual_board.h"

#include "reference.h"
#include "digitizer.h"

#define MOST_NS 60000000 /* simulated time per input. Chosen: bounds the run time */
#define REST_V 1.65

static const struct dg_board as_emulated = {
    .ticks_per_us = 48,
    .min_ticks = 96,
    .max_ticks = 65536,
    .volts_per_count = (float)(3.3 / 4096),
    .zero_count = 2048,
    .max_count = 4095,
};

struct bench {
    struct input input;
    struct virtual_board *board;
    struct host host;
    int64_t now_ns;
    uint64_t next;    /* index of the sample after the last one heard of */
    uint32_t missing; /* packets, then */
};

/* The line is at rest, and no samples are lost except in dropped packets. */
static void hear_samples(void *context, const struct line_packet *packet, uint64_t place)
{
    struct bench *bench = context;
    bool dropped = bench->host.missing != bench->missing;

    (void)place;
    MUST(packet->first == bench->next || packet->first == 0 || dropped, UNCOUNTED_LOSS);
    MUST(!(packet->flags & TP_FLAG_OVERRUN), UNCOUNTED_LOSS);
    for (uint32_t i = 0; packet->words && i < packet->count; i++) {
        uint16_t sent;
        memcpy(&sent, packet->words + 2 * i, sizeof sent);
        sent ^= TP_SAMPLE_XOR;
        MUST(sent == 2048 || sent == 8 * 2048, WRONG_VALUE);
    }
    bench->next = packet->first + packet->count;
    bench->missing = bench->host.missing;
}

static void listen(struct bench *bench)
{
    uint8_t bytes[4096];
    size_t size;

    while ((size = board_read(bench->board, bytes, sizeof bytes)) != 0)
        host_hears(&bench->host, bytes, size);
}

static void write(struct bench *bench, const uint8_t *bytes, size_t size)
{
    host_sends(&bench->host, bytes, size);
    board_write(bench->board, bytes, size);
}

static void run(struct bench *bench, int64_t ns)
{
    bench->now_ns += ns;
    board_run(bench->board, bench->now_ns);
}

static void step(struct bench *bench)
{
    uint8_t wire[COMMANDS_MAX];
    const uint8_t *bytes;
    size_t size;

    switch (input_u8(&bench->input) % 5) {
    case 0:
        size = input_bytes(&bench->input, &bytes, input_u8(&bench->input));
        write(bench, bytes, size);
        break;
    case 1:
        size = commands_any(&bench->input, wire);
        write(bench, wire, size);
        break;
    case 2:
        size = commands_configure(&bench->input, &as_emulated, wire);
        size += commands_plain(&bench->input, TP_START, wire + size);
        write(bench, wire, size);
        break;
    case 3:
        run(bench, input_u16(&bench->input) * 200);
        break;
    case 4:
        listen(bench);
        break;
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    static struct bench bench;
    struct amplifier amplifier = {.offset_v = REST_V, .polarity = 1, .high_v = 3.3};
    struct skin *skin = skin_create(&amplifier);

    memset(&bench, 0, sizeof bench);
    bench.input = (struct input){bytes, size};
    uint32_t rate = input_u16(&bench.input) * 64u;
    bench.board = board_create(skin, REST_V, (input_u8(&bench.input) - 128) * 1e-4, rate);
    host_init(&bench.host, &as_emulated);
    bench.host.samples = hear_samples;
    bench.host.context = &bench;
    while (bench.input.left && bench.now_ns < MOST_NS)
        step(&bench);
    listen(&bench);
    host_free(&bench.host);
    board_free(bench.board);
    skin_free(skin);
    return 0;
}
