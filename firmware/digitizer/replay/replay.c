// SPDX-License-Identifier: Apache-2.0

/* Runs the digitizer's core on recorded events and writes what it sends, on any machine.
 *
 *     replay EVENTS OUTPUT
 *
 * EVENTS is a struct start followed by events, each a struct event and `size` bytes. OUTPUT receives
 * the pulses and the bytes sent, in the order in which events ask for them. Prints the number of
 * samples and, where they can be counted, the instructions spent on them.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "digitizer.h"
#include "instructions.h"

#define BOARD_SIZE (offsetof(struct dg_board, max_count) + sizeof(int16_t)) /* without pointers */

struct __attribute__((packed)) start {
    uint64_t now_us;
    uint32_t output_size, sample_capacity;
    uint8_t board[BOARD_SIZE]; /* the beginning of a struct dg_board */
};

struct __attribute__((packed)) event {
    uint8_t kind; /* one of enum kind */
    uint32_t size;
};

enum kind {
    RECEIVE = 'r', /* bytes from the host */
    SAMPLES = 's', /* u16 counts */
    LOST = 'l',    /* u32: number of samples */
    TIME = 't',    /* u64: µs */
    PULSES = 'p',  /* u32: number of pulses to take */
    SEND = 'o',    /* u32: most bytes to send */
};

static union {
    uint8_t bytes[1 << 16];
    uint16_t counts[1 << 15];
    uint32_t number;
    uint64_t now_us;
} data; /* of an event */

static void fail(const char *what)
{
    fprintf(stderr, "replay: %s\n", what);
    exit(1);
}

static void *allocate(size_t size)
{
    void *memory = malloc(size);

    if (!memory)
        fail("no memory of the size that the events ask for");
    return memory;
}

static void give_pulses(struct dg *dg, uint32_t count, FILE *output)
{
    struct dg_pulse pulse;

    while (count-- && dg_pulse(dg, &pulse)) {
        fwrite(&pulse.tick, sizeof pulse.tick, 1, output);
        fwrite(&pulse.units, sizeof pulse.units, 1, output);
    }
}

static void send(struct dg *dg, size_t most, FILE *output)
{
    const uint8_t *bytes;
    size_t size;

    while (most && (size = dg_output(dg, &bytes)) != 0) {
        if (size > most)
            size = most;
        fwrite(bytes, 1, size, output);
        dg_sent(dg, size);
        most -= size;
    }
}

/* Reads the next event, and its data; false at the end of the file. */
static bool next_event(FILE *events, struct event *event)
{
    if (fread(event, sizeof *event, 1, events) != 1)
        return false;
    if (event->size > sizeof data || fread(data.bytes, 1, event->size, events) != event->size)
        fail("an event is longer than 65536 bytes, or than the rest of its file");
    return true;
}

static void replay(FILE *events, FILE *output)
{
    static struct dg dg;
    struct start start;
    struct event event;
    unsigned long samples = 0, instructions = 0;

    if (fread(&start, sizeof start, 1, events) != 1)
        fail("the events have no start");
    struct dg_board board = {.command = NULL};
    memcpy(&board, start.board, sizeof start.board);
    uint64_t now_us = start.now_us;
    dg_init(&dg, &board, allocate(start.output_size), start.output_size,
            allocate(start.sample_capacity * sizeof(int16_t)), start.sample_capacity, now_us);

    while (next_event(events, &event)) {
        switch ((enum kind)event.kind) {
        case RECEIVE:
            dg_receive(&dg, data.bytes, event.size, now_us);
            if (dg_restarted(&dg) && dg.running)
                dg_begin(&dg, now_us);
            break;
        case SAMPLES:
            samples += event.size / sizeof data.counts[0];
            instructions -= instructions_so_far();
            dg_samples(&dg, data.counts, event.size / sizeof data.counts[0]);
            instructions += instructions_so_far();
            break;
        case LOST:
            dg_lost(&dg, data.number);
            break;
        case TIME:
            now_us = data.now_us;
            dg_time(&dg, now_us);
            break;
        case PULSES:
            give_pulses(&dg, data.number, output);
            break;
        case SEND:
            send(&dg, data.number, output);
            break;
        default:
            fail("an event of unknown kind");
        }
    }
    printf("%lu samples, %lu instructions\n", samples, instructions);
}

int main(int argc, char **argv)
{
    if (argc != 3)
        fail("usage: replay EVENTS OUTPUT");
    FILE *events = fopen(argv[1], "rb"), *output = fopen(argv[2], "wb");
    if (!events || !output)
        fail("cannot open the files");
    replay(events, output);
    if (fclose(output))
        fail("cannot write all of the output");
    return 0;
}
