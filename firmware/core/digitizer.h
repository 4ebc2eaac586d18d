// SPDX-License-Identifier: Apache-2.0

/* The digitizer without its board: commands and samples in, packets and sync pulses out.
 *
 * Nothing here waits, allocates or touches hardware. A board
 *
 *   - passes on bytes from the host (dg_receive), sends the output (dg_output, dg_sent), and calls
 *     dg_time often enough for a report each second;
 *   - asks after every dg_receive whether to restart sampling (dg_restarted), as dg->running and
 *     dg->ticks_per_sample then say;
 *   - passes on every sample (dg_samples), or the number of samples lost (dg_lost);
 *   - makes the pulses that dg_pulse returns; on the data wire it takes the next one before it passes on samples
 *     that follow the one before.
 *
 * loop.h does all but the last for a board that supplies struct dg_hardware (board.h).
 *
 * Time within a stream is counted in ticks of the board's sampling clock. Sample i's period begins
 * at tick i · ticks_per_sample, and the sample is taken in its middle. Sync pulses are placed in the
 * same ticks, so the first sample of a frame is computed exactly, without interrupt latency.
 *
 * dg_pulse, dg_heard and dg_sync_fault may be called from an interrupt, all others from one context only.
 * Link it with: digitizer, setup, stream, pull, pulses, packet, cobs and crc32.
 */
#ifndef TACTILE_DIGITIZER_H
#define TACTILE_DIGITIZER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "board.h"
#include "packet.h"
#include "pull.h"
#include "pulses.h"
#include "setup.h"
#include "stream.h"

#define DG_FIRMWARE_MAJOR 1
#define DG_FIRMWARE_MINOR 0
#define DG_REPORT_US 1000000 /* interval of INFO and STATUS, µs */

/* Smallest output ring in bytes: room for one packet of this many samples and for the reports. A
 * larger ring lets the host fall behind for longer. */
#define DG_OUTPUT_MIN(samples) \
    (PACKET_MAX(sizeof(struct tp_samples) + 2 * (samples)) + STREAM_RESERVE)

struct dg {
    /* For the board to read: */
    bool running;
    uint32_t ticks_per_sample;

    const struct dg_board *board;
    bool restarted; /* and the board has not asked since */
    bool begun;     /* a stream is under way */
    uint64_t report_us;
    uint32_t commands_refused;
    volatile uint32_t sync_faults;
    struct setup setup;
    struct packet_reader reader;
    struct packet_writer writer;
    struct pulses pulses;
    struct pull pull;
    struct stream stream;
};

/* Power-up. output: the ring of bytes to send, at least DG_OUTPUT_MIN(samples of a packet). samples: room
 * for as many, which may be fewer than TP_MAX_SAMPLES or more; longer frames are never sent as QUIET.
 * The digitizer keeps the pointers. */
void dg_init(struct dg *dg, const struct dg_board *board, uint8_t *output, size_t output_size,
             int16_t *samples, size_t sample_capacity, uint64_t now_us);

/* Processes bytes from the host, however they are divided. */
void dg_receive(struct dg *dg, const uint8_t *bytes, size_t size, uint64_t now_us);

/* Whether sampling has to stop or restart, as dg->running and dg->ticks_per_sample now say; true once
 * per change. If running, the board then calls dg_begin with the time of tick 0; samples passed on
 * before that are ignored. */
bool dg_restarted(struct dg *dg);
void dg_begin(struct dg *dg, uint64_t start_us);
/* Stops as the command STOP does. */
void dg_stop(struct dg *dg);
/* Ends a stream that the board itself has to restart: sends the samples so far. dg_begin follows. */
void dg_end(struct dg *dg);

/* The next samples of the stream, in the converter's counts. */
void dg_samples(struct dg *dg, const uint16_t *counts, size_t size);
/* `size` samples of the stream were lost. */
void dg_lost(struct dg *dg, uint32_t size);

/* Takes the next pulse of the sync line: each once, in order. The board asks at most PULSES_AHEAD
 * frames ahead of the samples. False if there is none (not running, or frames are not marked). */
bool dg_pulse(struct dg *dg, struct dg_pulse *pulse);
/* Another digitizer's frame, which this one is to begin its own with (HEAR), begins at this time, modulo 2³² µs. On a
 * board that hears, take the next pulse as on the data wire. */
void dg_heard(struct dg *dg, uint32_t us);
/* The stream is too far off those frames: it has to begin anew. */
bool dg_strayed(const struct dg *dg);
/* Counts a pulse that was late or missing. */
void dg_sync_fault(struct dg *dg);

/* Sends the reports that are due; now_us is on the clock of device_time_us. */
void dg_time(struct dg *dg, uint64_t now_us);

/* The next bytes to send, as many as are contiguous in the ring; 0: none. */
size_t dg_output(const struct dg *dg, const uint8_t **bytes);
/* `size` of them were sent: frees their room. */
void dg_sent(struct dg *dg, size_t size);
/* Its host no longer reads: drops and counts the packets that are not yet begun to be sent. */
void dg_drop(struct dg *dg, size_t begun);

#endif
