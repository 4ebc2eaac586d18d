// SPDX-License-Identifier: Apache-2.0

#include "virtual_board.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "digitizer.h"

#define STEP_NS 500000
#define TICKS_PER_US 48
#define COUNTS 4096
#define FULL_SCALE_V 3.3
#define BLOCK 1024         /* most samples passed on at once */
#define OUTPUT_SIZE 65536

struct virtual_board {
    struct skin *skin;
    struct dg_board description;
    struct dg dg;
    uint8_t output[OUTPUT_SIZE];
    int16_t samples[TP_MAX_SAMPLES];

    int64_t now_ns;
    double tick_ns;

    uint64_t start_tick, taken; /* of the stream: its start; samples passed on */
    bool pulse_known;
    struct dg_pulse pulse; /* the next one */

    double link_rate, link_room; /* bytes/s; bytes that may be sent now */
    uint8_t *received;           /* by the host and not yet read */
    size_t received_size, received_capacity;
};

static uint64_t device_us(const struct virtual_board *board)
{
    return (uint64_t)((double)board->now_ns / board->tick_ns / TICKS_PER_US);
}

struct virtual_board *board_create(struct skin *skin, double offset_v, double clock_error,
                                   double link_rate)
{
    struct virtual_board *board = calloc(1, sizeof *board);

    board->skin = skin;
    board->tick_ns = 1e3 / TICKS_PER_US / (1 + clock_error);
    board->link_rate = link_rate;
    board->description = (struct dg_board){
        .ticks_per_us = TICKS_PER_US,
        .min_ticks = 96, /* as an RP2040's converter */
        .max_ticks = 65536,
        .volts_per_count = (float)(FULL_SCALE_V / COUNTS),
        .zero_count = (int16_t)(offset_v / FULL_SCALE_V * COUNTS + 0.5),
        .min_count = 0,
        .max_count = COUNTS - 1,
    };
    memcpy(board->description.id, TP_SIMULATED_ID "emul", sizeof board->description.id);
    dg_init(&board->dg, &board->description, board->output, sizeof board->output, board->samples,
            TP_MAX_SAMPLES, 0);
    return board;
}

void board_free(struct virtual_board *board)
{
    free(board->received);
    free(board);
}

void board_write(struct virtual_board *board, const uint8_t *bytes, size_t size)
{
    dg_receive(&board->dg, bytes, size, device_us(board));
    if (!dg_restarted(&board->dg))
        return;
    board->pulse_known = false;
    if (board->dg.running) {
        uint64_t start_us = device_us(board) + 1;
        board->start_tick = start_us * TICKS_PER_US;
        board->taken = 0;
        dg_begin(&board->dg, start_us);
    }
}

size_t board_read(struct virtual_board *board, uint8_t *bytes, size_t size)
{
    if (size > board->received_size)
        size = board->received_size;
    if (!size)
        return 0; /* `received` may be NULL */
    memcpy(bytes, board->received, size);
    board->received_size -= size;
    memmove(board->received, board->received + size, board->received_size);
    return size;
}

static double stream_ns(const struct virtual_board *board, uint64_t tick)
{
    return (double)(board->start_tick + tick) * board->tick_ns;
}

/* Announces the pulses that begin before a time. */
static void announce_pulses(struct virtual_board *board, int64_t end_ns)
{
    while (board->dg.running) {
        uint64_t length = (uint64_t)board->pulse.units * TP_SYNC_UNIT_US * TICKS_PER_US;
        int64_t rise_ns = (int64_t)(stream_ns(board, board->pulse.tick) + 0.5);

        if (board->pulse_known && rise_ns >= end_ns)
            return;
        if (board->pulse_known &&
            !(skin_sync(board->skin, rise_ns, true) &&
              skin_sync(board->skin, (int64_t)(stream_ns(board, board->pulse.tick + length) + 0.5),
                        false)))
            dg_sync_fault(&board->dg);
        board->pulse_known = dg_pulse(&board->dg, &board->pulse);
        if (!board->pulse_known)
            return;
    }
}

/* Passes on the samples whose instants lie before now. */
static void take_samples(struct virtual_board *board)
{
    uint32_t ticks = board->dg.ticks_per_sample;
    double volts[BLOCK];
    uint16_t counts[BLOCK];

    while (board->dg.running) {
        double first_ns = stream_ns(board, board->taken * ticks + ticks / 2);
        double step_ns = ticks * board->tick_ns;
        double due = ceil(((double)board->now_ns - first_ns) / step_ns);

        if (due <= 0)
            return;
        size_t size = due < BLOCK ? (size_t)due : BLOCK;
        skin_volts(board->skin, first_ns, step_ns, volts, size);
        for (size_t i = 0; i < size; i++) {
            double count = volts[i] / FULL_SCALE_V * COUNTS;
            counts[i] = count < 0 ? 0 : count >= COUNTS ? COUNTS - 1 : (uint16_t)count;
        }
        dg_samples(&board->dg, counts, size);
        board->taken += size;
    }
}

static void receive(struct virtual_board *board, const uint8_t *bytes, size_t size)
{
    if (board->received_size + size > board->received_capacity) {
        board->received_capacity = 2 * (board->received_size + size);
        board->received = realloc(board->received, board->received_capacity);
    }
    memcpy(board->received + board->received_size, bytes, size);
    board->received_size += size;
}

/* Sends what the link carries in one step. */
static void send(struct virtual_board *board)
{
    const uint8_t *bytes;
    size_t size;

    board->link_room += board->link_rate * STEP_NS / 1e9;
    while ((size = dg_output(&board->dg, &bytes))) {
        if (board->link_rate > 0 && (double)size > board->link_room)
            size = (size_t)board->link_room;
        if (!size)
            return;
        receive(board, bytes, size);
        dg_sent(&board->dg, size);
        board->link_room -= (double)size;
    }
    board->link_room = 0; /* an idle link accumulates no credit */
}

void board_run(struct virtual_board *board, int64_t t_ns)
{
    while (board->now_ns < t_ns) {
        int64_t end_ns = (board->now_ns / STEP_NS + 1) * STEP_NS;

        if (end_ns > t_ns)
            end_ns = t_ns;
        announce_pulses(board, end_ns);
        skin_run(board->skin, end_ns);
        board->now_ns = end_ns;
        take_samples(board);
        dg_time(&board->dg, device_us(board));
        if (end_ns % STEP_NS == 0)
            send(board);
    }
}
