// SPDX-License-Identifier: Apache-2.0

/* Finds the packets in a stream of bytes, as tactile_cdma/wire/packets.py says: COBS, CRC-32, header,
 * sequence. What it finds and counts does not depend on how the stream is divided. */
#ifndef TACTILE_SCANNER_H
#define TACTILE_SCANNER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "../firmware/core/tactile_protocol.h"

/* Fields of `Counters` in packets.py, less what only the meaning of a packet shows. */
struct scanner_counts {
    uint64_t bytes, packets, crc_errors, framing_errors, malformed, lost_packets, jumps,
        repeated_packets, resyncs, text_bytes;
};

/* An intact packet. The payload lies in the scanner until it is used again. again: it came before, or
 * is the same after a reset. jumped: its sequence is not that of the stream before. */
struct scanner_packet {
    uint8_t type;
    uint16_t sequence;
    const uint8_t *payload;
    size_t size;
    bool again, jumped;
};

struct scanner;

/* most_repeated: packets in a row that are taken for repetitions. NULL: out of memory. */
struct scanner *scanner_new(unsigned long most_repeated);
void scanner_free(struct scanner *scanner);

/* Takes bytes up to the end of the next packet, or all. Returns how many; packet->payload is NULL where there is no
 * packet. */
size_t scanner_take(struct scanner *scanner, const uint8_t *bytes, size_t size, struct scanner_packet *packet);
/* Bytes were left out here. */
void scanner_skip(struct scanner *scanner);
/* Bytes of an incomplete packet. */
size_t scanner_held(const struct scanner *scanner);
/* The counts of now, always in the same place: other threads may read them there while this one scans. */
const struct scanner_counts *scanner_tell(struct scanner *scanner);

/* Number of samples in a packet, packed or not; 0 if it is none of samples, or malformed. */
size_t scanner_samples(const struct scanner_packet *packet);
/* Copies them out; counts: int16, of any alignment. packet: one that has some. */
void scanner_copy_samples(const struct scanner_packet *packet, struct tp_samples *head, void *counts);

/* A packet of samples; if quiet, they are not in it, but their mean and variance, counts, which are exact unless they
 * do not fit, or cannot be. */
struct scanner_content {
    uint64_t first_index, device_us;
    uint32_t count;
    uint16_t sequence;
    bool sync, asked, quiet, is_exact;
    uint8_t turn;
    double mean, variance;
    int16_t counts[TP_MAX_SAMPLES];
};

/* Takes a packet of samples apart; false for any other, or one that is malformed. */
bool scanner_read(const struct scanner_packet *packet, struct scanner_content *content);

#endif
