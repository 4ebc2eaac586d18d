// SPDX-License-Identifier: Apache-2.0

#include "packet.h"

#include <string.h>

#include "crc32.h"

#define CRC_SIZE sizeof(uint32_t)
#define LONGEST_RUN (TP_MAX_PACKET - 1)

void packet_writer_init(struct packet_writer *writer, uint8_t *ring, size_t size)
{
    memset(writer, 0, sizeof *writer);
    writer->ring = ring;
    writer->size = size;
    ring[0] = 0; /* ends whatever bytes the host received before */
    writer->used = 1;
}

bool packet_open(struct packet_writer *writer, uint8_t type, size_t payload, size_t reserve)
{
    struct tp_header header = {.type = type, .sequence = writer->sequence++};

    if (writer->used + PACKET_MAX(payload) + reserve > writer->size) {
        writer->dropped++;
        return false;
    }
    size_t end = writer->begin + writer->used;
    if (end >= writer->size)
        end -= writer->size;
    cobs_begin(&writer->cobs, writer->ring, writer->size, end);
    writer->crc = 0;
    packet_put(writer, &header, sizeof header);
    return true;
}

void packet_put(struct packet_writer *writer, const void *bytes, size_t size)
{
    writer->crc = crc32_update(writer->crc, bytes, size);
    cobs_put(&writer->cobs, bytes, size);
}

void packet_close(struct packet_writer *writer)
{
    cobs_put(&writer->cobs, &writer->crc, CRC_SIZE);
    size_t end = cobs_end(&writer->cobs);
    /* A packet is never empty: if end equals begin, the ring is full. */
    writer->used = end > writer->begin ? end - writer->begin : end + writer->size - writer->begin;
}

size_t packet_output(const struct packet_writer *writer, const uint8_t **bytes)
{
    size_t together = writer->size - writer->begin;

    *bytes = writer->ring + writer->begin;
    return writer->used < together ? writer->used : together;
}

void packet_sent(struct packet_writer *writer, size_t size)
{
    writer->used -= size;
    writer->begin += size;
    if (writer->begin >= writer->size)
        writer->begin -= writer->size;
}

static uint8_t output_byte(const struct packet_writer *writer, size_t place)
{
    size_t at = writer->begin + place;

    return writer->ring[at < writer->size ? at : at - writer->size];
}

void packet_drop(struct packet_writer *writer, size_t begun)
{
    size_t kept = begun;

    while (kept && kept < writer->used && output_byte(writer, kept - 1))
        kept++;
    for (size_t place = kept; place < writer->used; place++)
        writer->dropped += !output_byte(writer, place);
    writer->used = kept;
}

static void take(struct packet_reader *reader, uint8_t byte)
{
    size_t place = reader->raw++;

    reader->crc = crc32_update(reader->crc, &byte, 1);
    if (place < sizeof reader->header)
        ((uint8_t *)&reader->header)[place] = byte;
    else if (place < sizeof reader->header + PACKET_KEPT)
        reader->payload[place - sizeof reader->header] = byte;
}

/* Whether the run of bytes ended by a zero is a packet; if not, it counts as one error. */
static bool finish(struct packet_reader *reader)
{
    if (reader->run == 0)
        return false;
    if (reader->run > LONGEST_RUN || !cobs_whole(&reader->cobs) ||
        reader->raw < sizeof reader->header + CRC_SIZE || reader->crc != CRC32_RESIDUE) {
        reader->errors++;
        return false;
    }
    reader->payload_size = reader->raw - sizeof reader->header - CRC_SIZE;
    return true;
}

bool packet_read(struct packet_reader *reader, uint8_t byte)
{
    uint8_t decoded;

    if (byte == 0) {
        bool whole = finish(reader);
        memset(&reader->cobs, 0, sizeof reader->cobs);
        reader->crc = 0;
        reader->run = reader->raw = 0;
        return whole;
    }
    if (reader->run > LONGEST_RUN)
        return false; /* too long for a packet: ignored up to the next zero */
    reader->run++;
    if (cobs_decode(&reader->cobs, byte, &decoded))
        take(reader, decoded);
    return false;
}
