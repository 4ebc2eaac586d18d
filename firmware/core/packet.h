// SPDX-License-Identifier: Apache-2.0

/* Packets ↔ bytes: header, CRC-32, COBS and delimiter. See docs/protocol.md. */
#ifndef TACTILE_PACKET_H
#define TACTILE_PACKET_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "cobs.h"
#include "tactile_protocol.h"

/* Most bytes on the wire of a packet with so large a payload. */
#define PACKET_MAX(payload) \
    (COBS_MAX(sizeof(struct tp_header) + (payload) + sizeof(uint32_t)) + 1)

/* Numbers packets and puts them into a ring of bytes to be sent. */
struct packet_writer {
    uint8_t *ring;
    size_t size, begin, used; /* of the ring; its oldest byte; bytes in it */
    uint16_t sequence;        /* of the next packet */
    uint32_t dropped;         /* packets, for want of room */
    struct cobs_encoder cobs; /* of the open packet */
    uint32_t crc;
};

void packet_writer_init(struct packet_writer *writer, uint8_t *ring, size_t size);

/* A packet with `payload` bytes, which packet_put then gives in pieces. It must find room beside
 * `reserve` bytes of the ring; false where it doesn't: then it is dropped and counted. */
bool packet_open(struct packet_writer *writer, uint8_t type, size_t payload, size_t reserve);
void packet_put(struct packet_writer *writer, const void *bytes, size_t size);
void packet_close(struct packet_writer *writer);

/* The oldest bytes, as far as they lie together; and that so many of them are gone. */
size_t packet_output(const struct packet_writer *writer, const uint8_t **bytes);
void packet_sent(struct packet_writer *writer, size_t size);

#define PACKET_KEPT sizeof(struct tp_configure) /* the longest command's payload */

/* Finds packets among bytes. Of longer payloads than any command's only the size is known. */
struct packet_reader {
    struct tp_header header; /* of the packet just read */
    uint8_t payload[PACKET_KEPT];
    size_t payload_size;
    uint32_t errors; /* runs of bytes between zeros that were no packet */

    struct cobs_decoder cobs;
    uint32_t crc;
    size_t run, raw; /* bytes since the last zero: as they came; decoded */
};

/* The next byte. Returns whether it ends an intact packet. */
bool packet_read(struct packet_reader *reader, uint8_t byte);

#endif
