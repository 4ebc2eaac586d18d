// SPDX-License-Identifier: Apache-2.0

/* The digitizer without its board: commands and samples in, packets and sync pulses out.
 *
 * Nothing here waits, allocates or touches hardware. A board
 *
 *   - hands over what arrives from the host (dg_receive), takes what is to be sent (dg_output,
 *     dg_sent), and calls dg_time now and then for the reports of each second;
 *   - asks after every dg_receive whether sampling has to start anew (dg_restarted), and then does
 *     what dg->running and dg->ticks_per_sample say;
 *   - hands over every sample (dg_samples), or says how many it could not keep (dg_lost);
 *   - makes the pulses that dg_pulse announces.
 *
 * Time within a stream is counted in ticks of the board's sampling clock. Sample i's period begins
 * at tick i · ticks_per_sample, and the sample is taken in its middle. Sync pulses are given in the
 * same ticks, so where frames begin among the samples is arithmetic: no interrupt's latency and no
 * search is in it.
 *
 * dg_pulse and dg_sync_fault may be called from an interrupt; everything else from one context
 * only. To be linked: digitizer, setup, stream, pulses, packet, cobs and crc32.
 */
#ifndef TACTILE_DIGITIZER_H
#define TACTILE_DIGITIZER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "board.h"
#include "packet.h"
#include "pulses.h"
#include "setup.h"
#include "stream.h"

#define DG_FIRMWARE_MAJOR 1
#define DG_FIRMWARE_MINOR 0
#define DG_REPORT_US 1000000 /* INFO and STATUS are repeated at this interval */

/* Least size of the output ring: a packet of so many samples fits beside the reports. A board has
 * better several times as much: what a slow host may be behind. */
#define DG_OUTPUT_MIN(samples) \
    (PACKET_MAX(sizeof(struct tp_samples) + 2 * (samples)) + STREAM_RESERVE)

struct dg {
    /* For the board to read: */
    bool running;
    uint32_t ticks_per_sample;

    const struct dg_board *board;
    bool restarted; /* and the board doesn't know yet */
    bool begun;     /* samples that come are the stream's */
    uint64_t report_us;
    uint32_t commands_refused;
    volatile uint32_t sync_faults;
    struct setup setup;
    struct packet_reader reader;
    struct packet_writer writer;
    struct pulses pulses;
    struct stream stream;
};

/* Power-up. output: the ring of bytes to be sent, at least DG_OUTPUT_MIN of the capacity. samples:
 * room for a packet's samples, at most TP_MAX_SAMPLES of them; frames that are longer are sent in
 * pieces and never as QUIET. All given stays the digitizer's. */
void dg_init(struct dg *dg, const struct dg_board *board, uint8_t *output, size_t output_size,
             int16_t *samples, size_t sample_capacity, uint64_t now_us);

/* Bytes from the host, in any pieces. */
void dg_receive(struct dg *dg, const uint8_t *bytes, size_t size, uint64_t now_us);

/* Whether sampling has to stop, or to start anew as dg->running and dg->ticks_per_sample now say;
 * true once per change. Then call dg_begin, if running, with the time of tick 0; samples that are
 * handed over before that are none of the stream's. */
bool dg_restarted(struct dg *dg);
void dg_begin(struct dg *dg, uint64_t start_us);
/* A board has to start anew by itself, and does so with dg_begin: the samples until now are sent. */
void dg_end(struct dg *dg);

/* The next samples of the stream, in the converter's counts. */
void dg_samples(struct dg *dg, const uint16_t *counts, size_t size);
/* So many samples of the stream could not be kept. */
void dg_lost(struct dg *dg, uint32_t size);

/* The next pulse of the sync line: in order, each once, at most PULSES_AHEAD frames ahead of the
 * samples. False where there is none (not running, or frames are not marked). */
bool dg_pulse(struct dg *dg, struct dg_pulse *pulse);
/* A pulse came late or not at all. */
void dg_sync_fault(struct dg *dg);

/* What time it is, on the clock of device_time_us. */
void dg_time(struct dg *dg, uint64_t now_us);

/* The bytes that are to be sent next, as far as they lie together in the ring; 0: none. */
size_t dg_output(const struct dg *dg, const uint8_t **bytes);
/* So many of them were sent. */
void dg_sent(struct dg *dg, size_t size);

#endif
