// SPDX-License-Identifier: Apache-2.0

/* A digitizer whose host, samples and time come from the input: commands of every kind, broken ones
 * included, during a stream; lost samples; a host that reads at any time. */
#include "digitizer.h"

#include <stdlib.h>

#include "reference.h"

#define MOST_SAMPLES 12000 /* per input. Chosen: bounds the run time */
#define MOST_SESSIONS 16
#define MOST_AT_ONCE 1024

static const struct dg_board boards[] = {
    {"rp2040", 48, 96, 65536, 0x1p-10f, 2048, 0, 4095, NULL, NULL, false, false},
    {"slow", 8, 80, 70000, 0.0008f, 0, 0, 1023, NULL, NULL, false, false},
    {"fast", 1000, 10, 4194303, 0.0012f, 1000, 10, 4000, NULL, NULL, false, false},
    {"odd", 125, 1, 5000, 0x1p-11f, 4095, 0, 4095, NULL, NULL, false, false},
};

struct session {
    struct line line;
    uint64_t begin;   /* bytes made before it */
    uint32_t missing; /* packets, when it was last heard of */
    bool whole;       /* was sent to its end */
};

struct bench {
    struct input input;
    struct dg dg;
    struct host host;
    uint8_t *output;
    int16_t *samples;
    uint64_t now_us, sent;
    struct session sessions[MOST_SESSIONS];
    size_t begun, heard; /* sessions */
    size_t samples_left;
    uint32_t sync_faults, noise;
};

static struct session *present(struct bench *bench)
{
    return bench->host.running ? &bench->sessions[bench->begun - 1] : NULL;
}

/* All of a completed stream has been received, unless packets are missing. */
static void check_end(const struct bench *bench, const struct session *session)
{
    if (session->whole && bench->host.missing == session->missing)
        line_check_end(&session->line);
}

static void hear_samples(void *context, const struct line_packet *packet, uint64_t place)
{
    struct bench *bench = context;

    MUST(bench->begun > 0, WRONG_VALUE);
    while (bench->heard + 1 < bench->begun && bench->sessions[bench->heard + 1].begin <= place) {
        struct session *over = &bench->sessions[bench->heard++];
        check_end(bench, over);
        bench->sessions[bench->heard].missing = over->missing;
    }
    struct session *session = &bench->sessions[bench->heard];
    line_check(&session->line, packet, bench->host.missing != session->missing);
    session->missing = bench->host.missing;
}

static void begin_session(struct bench *bench)
{
    struct session *session = &bench->sessions[bench->begun++];
    uint64_t start_us = bench->now_us + input_u8(&bench->input);

    line_init(&session->line, &bench->host.settings, start_us);
    session->line.rest = (uint16_t)bench->dg.board->zero_count;
    session->line.swing = (uint16_t)((bench->dg.board->max_count - bench->dg.board->min_count) / 4);
    session->begin = bench->sent + bench->dg.writer.used;
    MUST(bench->dg.ticks_per_sample == session->line.settings.ticks_per_sample, WRONG_VALUE);
    dg_begin(&bench->dg, start_us);
}

/* Actions */

static void send(struct bench *bench, size_t most)
{
    const uint8_t *bytes;
    size_t size;

    while (most && (size = dg_output(&bench->dg, &bytes)) != 0) {
        size = size < most ? size : most;
        host_hears(&bench->host, bytes, size);
        dg_sent(&bench->dg, size);
        bench->sent += size;
        most -= size;
    }
}

/* The board's part of dg_receive: see digitizer.h. */
static void receive_piece(struct bench *bench, const uint8_t *bytes, size_t size)
{
    static const uint16_t stale[3] = {1, 2, 3}; /* samples of no stream */
    struct host *host = &bench->host;

    host_sends(host, bytes, size);
    dg_receive(&bench->dg, bytes, size, bench->now_us);
    MUST(dg_restarted(&bench->dg) == host->restarted, WRONG_VALUE);
    MUST(bench->dg.running == host->running, WRONG_VALUE);
    if (host->restarted && host->running) {
        dg_samples(&bench->dg, stale, 3);
        dg_lost(&bench->dg, 3);
        begin_session(bench);
    }
    host->restarted = false;
}

static void receive(struct bench *bench, const uint8_t *bytes, size_t size)
{
    size_t piece = input_u8(&bench->input) % (size + 1);

    receive_piece(bench, bytes, piece);
    if (bench->begun < MOST_SESSIONS)
        receive_piece(bench, bytes + piece, size - piece);
}

/* The pulses that must come before the next sample, and up to `more`. */
static void ask_pulses(struct bench *bench, unsigned more)
{
    struct host *host = &bench->host;
    struct session *session = present(bench);
    struct dg_pulse pulse;

    if (!session || !session->line.settings.marked) {
        MUST(!dg_pulse(&bench->dg, &pulse), WRONG_VALUE);
        return;
    }
    struct line *line = &session->line;
    while (line_covered(line) <= line->size || (more && line_ahead(line) < PULSES_AHEAD)) {
        more -= more > 0;
        MUST(dg_pulse(&bench->dg, &pulse), WRONG_VALUE);
        line_pulse(line, &pulse, &host->wishes);
    }
}

/* Counts at rest, rising, or arbitrary. */
static void sample(struct bench *bench, uint16_t *counts, size_t size)
{
    uint8_t shape = input_u8(&bench->input);
    uint16_t level = input_u16(&bench->input) % 4096;

    for (size_t i = 0; i < size; i++) {
        bench->noise = bench->noise * 1664525u + 1013904223u;
        uint32_t more = shape % 4 == 0   ? 0
                        : shape % 4 == 1 ? (uint32_t)i
                                         : bench->noise >> 20 >> (shape % 4 == 2 ? 10 : 0);
        counts[i] = (uint16_t)((level + more) % 4096);
    }
}

/* Samples, or their loss, up to the pulses taken so far; then further pulses. */
static void take_samples(struct bench *bench, bool lost)
{
    uint16_t counts[MOST_AT_ONCE];
    size_t size = input_u16(&bench->input) % MOST_AT_ONCE;
    unsigned pulses = input_u8(&bench->input) % 64;
    struct session *session = present(bench);

    size = size < bench->samples_left ? size : bench->samples_left;
    bench->samples_left -= size;
    sample(bench, counts, size);
    for (size_t done = 0, some; done < size; done += some) {
        ask_pulses(bench, pulses);
        some = size - done;
        if (session && line_covered(&session->line) - session->line.size < some)
            some = line_covered(&session->line) - session->line.size;
        if (session)
            line_add(&session->line, lost ? NULL : counts + done, some);
        if (lost)
            dg_lost(&bench->dg, (uint32_t)some);
        else
            dg_samples(&bench->dg, counts + done, some);
    }
}

static void pass_time(struct bench *bench)
{
    bench->now_us += (uint64_t)input_u16(&bench->input) << input_u8(&bench->input) % 16;
    dg_time(&bench->dg, bench->now_us);
}

/* Does what a board does after a missed pulse. */
static void begin_again(struct bench *bench)
{
    struct session *session = present(bench);

    if (!session)
        return;
    dg_sync_fault(&bench->dg);
    bench->sync_faults++;
    dg_end(&bench->dg);
    session->whole = true;
    begin_session(bench);
}

static void step(struct bench *bench)
{
    static uint8_t wire[COMMANDS_MAX];
    struct input *input = &bench->input;
    const uint8_t *bytes;
    size_t size;

    switch (input_u8(input) % 12) {
    case 0:
        size = input_bytes(input, &bytes, input_u8(input));
        receive(bench, bytes, size);
        break;
    case 1:
    case 2:
        size = commands_any(input, wire);
        receive(bench, wire, size);
        break;
    case 3:
    case 4:
        size = commands_configure(input, bench->dg.board, wire);
        size += commands_plain(input, TP_START, wire + size);
        receive(bench, wire, size);
        break;
    case 5:
    case 6:
    case 7:
        take_samples(bench, false);
        break;
    case 8:
        take_samples(bench, true);
        break;
    case 9:
        ask_pulses(bench, input_u8(input));
        pass_time(bench);
        break;
    case 10:
        send(bench, input_u16(input));
        break;
    case 11:
        begin_again(bench);
        break;
    }
}

static void finish(struct bench *bench)
{
    struct session *session = present(bench);
    const struct tp_status *status = &bench->host.status;
    uint32_t lost = 0, unseen = 0;

    if (session) {
        dg_end(&bench->dg);
        session->whole = true;
    }
    send(bench, SIZE_MAX);
    bench->now_us += DG_REPORT_US;
    dg_time(&bench->dg, bench->now_us);
    send(bench, SIZE_MAX);
    host_check_end(&bench->host);
    if (bench->begun)
        check_end(bench, &bench->sessions[bench->begun - 1]);
    for (size_t i = 0; i < bench->begun; i++) {
        lost += line_lost(&bench->sessions[i].line);
        unseen += bench->sessions[i].line.unseen;
    }
    MUST(status->samples_lost == lost, UNCOUNTED_LOSS);
    MUST(status->sync_faults == bench->sync_faults + unseen, UNCOUNTED_LOSS);
    MUST(status->uptime_us == bench->now_us, WRONG_VALUE);
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    static struct bench bench;

    memset(&bench, 0, sizeof bench);
    bench.input = (struct input){bytes, size};
    bench.samples_left = MOST_SAMPLES;
    const struct dg_board *board = &boards[input_u8(&bench.input) % 4];
    size_t capacity = 1 + input_u16(&bench.input) % TP_MAX_SAMPLES;
    size_t output_size = DG_OUTPUT_MIN(capacity) + input_u16(&bench.input);
    bench.output = malloc(output_size);
    bench.samples = malloc(capacity * sizeof *bench.samples);
    host_init(&bench.host, board);
    bench.host.samples = hear_samples;
    bench.host.context = &bench;
    dg_init(&bench.dg, board, bench.output, output_size, bench.samples, capacity, 0);
    while (bench.input.left && bench.begun < MOST_SESSIONS)
        step(&bench);
    finish(&bench);
    for (size_t i = 0; i < bench.begun; i++)
        line_free(&bench.sessions[i].line);
    host_free(&bench.host);
    free(bench.samples);
    free(bench.output);
    return 0;
}
