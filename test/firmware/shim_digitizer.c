// SPDX-License-Identifier: Apache-2.0

/* What the tests of the digitizer's core need beside it: memory, and plain functions to call. */
#include <stdlib.h>
#include <string.h>

#include "cobs.h"
#include "crc32.h"
#include "digitizer.h"
#include "packet.h"

uint32_t shim_crc32(uint32_t crc, const uint8_t *bytes, size_t size)
{
    return crc32_update(crc, bytes, size);
}

/* The packet's bytes, delimiter included, put into a ring of just their size from `begin` on. */
size_t shim_cobs(const uint8_t *bytes, size_t size, size_t piece, uint8_t *ring, size_t ring_size,
                 size_t begin)
{
    struct cobs_encoder encoder;

    cobs_begin(&encoder, ring, ring_size, begin);
    for (size_t i = 0; i < size; i += piece)
        cobs_put(&encoder, bytes + i, size - i < piece ? size - i : piece);
    return cobs_end(&encoder);
}

/* Number of bytes decoded, or -1 where they are no COBS. */
long shim_cobs_decode(const uint8_t *bytes, size_t size, uint8_t *decoded)
{
    struct cobs_decoder decoder = {0};
    long count = 0;

    for (size_t i = 0; i < size; i++)
        count += cobs_decode(&decoder, bytes[i], decoded + count);
    return cobs_whole(&decoder) ? count : -1;
}


struct packet_reader *shim_reader_new(void)
{
    return calloc(1, sizeof(struct packet_reader));
}

void shim_reader_free(struct packet_reader *reader)
{
    free(reader);
}

/* Reads up to the end of a packet; returns how many bytes that took. whole: whether it was one. */
size_t shim_read(struct packet_reader *reader, const uint8_t *bytes, size_t size, bool *whole)
{
    *whole = false;
    for (size_t i = 0; i < size; i++) {
        *whole = packet_read(reader, bytes[i]);
        if (*whole)
            return i + 1;
    }
    return size;
}

/* The packet just read: type, sequence, payload as far as it is kept; returns the payload's size. */
size_t shim_packet(const struct packet_reader *reader, uint8_t *type, uint16_t *sequence,
                   uint8_t *payload)
{
    size_t kept = reader->payload_size < PACKET_KEPT ? reader->payload_size : PACKET_KEPT;

    *type = reader->header.type;
    *sequence = reader->header.sequence;
    memcpy(payload, reader->payload, kept);
    return reader->payload_size;
}

uint32_t shim_reader_errors(const struct packet_reader *reader)
{
    return reader->errors;
}

/* A packet, its payload given in pieces, in a ring that just has room for it; as it will be sent.
 * Returns its size, or 0 where it was dropped. */
size_t shim_write(uint8_t type, uint16_t sequence, const uint8_t *payload, size_t size, size_t piece,
                  size_t room, uint8_t *wire, size_t begin)
{
    uint8_t *ring = malloc(room);
    struct packet_writer writer;
    const uint8_t *bytes;
    size_t sent = 0;

    packet_writer_init(&writer, ring, room);
    writer.begin = begin % room;
    writer.used = 0;
    writer.sequence = sequence;
    if (packet_open(&writer, type, size, 0)) {
        for (size_t i = 0; i < size; i += piece)
            packet_put(&writer, payload + i, size - i < piece ? size - i : piece);
        packet_close(&writer);
    }
    for (size_t some; (some = packet_output(&writer, &bytes)) != 0; sent += some) {
        memcpy(wire + sent, bytes, some);
        packet_sent(&writer, some);
    }
    free(ring);
    return sent;
}

/* A digitizer and what it owns, each in memory of its own, so that sanitizers see its ends. */
struct shim_digitizer {
    struct dg dg;
    struct dg_board board;
    uint8_t *output;
    int16_t *samples;
};

struct shim_digitizer *shim_new(const struct dg_board *board, size_t output_size,
                                size_t sample_capacity, uint64_t now_us)
{
    struct shim_digitizer *shim = calloc(1, sizeof *shim);

    shim->board = *board;
    shim->output = malloc(output_size);
    shim->samples = malloc(sample_capacity * sizeof *shim->samples);
    dg_init(&shim->dg, &shim->board, shim->output, output_size, shim->samples, sample_capacity,
            now_us);
    return shim;
}

void shim_free(struct shim_digitizer *shim)
{
    free(shim->samples);
    free(shim->output);
    free(shim);
}

size_t shim_output_min(size_t sample_capacity)
{
    return DG_OUTPUT_MIN(sample_capacity);
}

bool shim_running(const struct shim_digitizer *shim)
{
    return shim->dg.running;
}

uint32_t shim_ticks_per_sample(const struct shim_digitizer *shim)
{
    return shim->dg.ticks_per_sample;
}

/* As after so many packets. */
void shim_set_sequence(struct shim_digitizer *shim, uint16_t sequence)
{
    shim->dg.writer.sequence = sequence;
}
