// SPDX-License-Identifier: Apache-2.0

/* Encodes and decodes packets: header, CRC-32, COBS and delimiter. See docs/protocol.md. */
#ifndef TACTILE_PACKET_H
#define TACTILE_PACKET_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "cobs.h"
#include "tactile_protocol.h"

/* Upper bound of a packet's bytes on the wire. payload: its size in bytes. */
#define PACKET_MAX(payload) \
    (COBS_MAX(sizeof(struct tp_header) + (payload) + sizeof(uint32_t)) + 1)

/* Numbers packets and encodes them into a ring of bytes to send. */
struct packet_writer {
    uint8_t *ring;
    size_t size, begin, used; /* of the ring; place of its oldest byte; bytes in it */
    uint16_t sequence;        /* of the next packet */
    uint32_t dropped;         /* packets, because the ring was full */
    struct cobs_encoder cobs; /* of the open packet */
    uint32_t crc;
};

void packet_writer_init(struct packet_writer *writer, uint8_t *ring, size_t size);

/* Begins a packet with `payload` bytes, which packet_put then adds in pieces. False if it would leave
 * fewer than `reserve` bytes of the ring free: then it is dropped and counted. */
bool packet_open(struct packet_writer *writer, uint8_t type, size_t payload, size_t reserve);
void packet_put(struct packet_writer *writer, const void *bytes, size_t size);
void packet_close(struct packet_writer *writer);

/* The oldest bytes, as many as are contiguous. packet_sent frees the first `size` of them. */
size_t packet_output(const struct packet_writer *writer, const uint8_t **bytes);
void packet_sent(struct packet_writer *writer, size_t size);
/* Drops and counts the packets that wait behind the one in which the oldest `begun` bytes end. */
void packet_drop(struct packet_writer *writer, size_t begun);

#define PACKET_KEPT sizeof(struct tp_configure) /* the longest command's payload */

/* Finds packets in a stream of bytes. Keeps the first PACKET_KEPT bytes of a payload. */
struct packet_reader {
    struct tp_header header; /* of the packet last read */
    uint8_t payload[PACKET_KEPT];
    size_t payload_size;
    uint32_t errors; /* runs of bytes between zeros that were not a packet */

    struct cobs_decoder cobs;
    uint32_t crc;
    size_t run, raw; /* bytes since the last zero: as received; decoded */
};

/* Takes the next byte. Returns whether it completes an intact packet. */
bool packet_read(struct packet_reader *reader, uint8_t byte);

#endif
