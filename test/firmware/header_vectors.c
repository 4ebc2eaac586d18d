// SPDX-License-Identifier: Apache-2.0

/* Makes the vectors' packets from the generated header alone and compares.
 *
 * vectors.inc, written by test_core_packets.py from firmware/vectors/protocol.json, holds one CHECK per
 * packet. COBS and CRC-32 are written here by docs/protocol.md, so that they check it, too.
 */
#include <stdio.h>
#include <string.h>

#include "tactile_protocol.h"

static int failures;

static uint32_t crc32(const uint8_t *data, size_t size)
{
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0; i < size; i++) {
        crc ^= data[i];
        for (int bit = 0; bit < 8; bit++)
            crc = (crc >> 1) ^ (crc & 1u ? 0xEDB88320u : 0u);
    }
    return ~crc;
}

static size_t cobs_encode(const uint8_t *data, size_t size, uint8_t *out)
{
    size_t block = 0, end = 1; /* where the open block's length goes; where the next byte goes */
    for (size_t i = 0; i < size; i++) {
        if (data[i])
            out[end++] = data[i];
        if (!data[i] || end - block == 255) {
            out[block] = (uint8_t)(end - block);
            if (data[i] && i + 1 == size)
                return end;
            block = end++;
        }
    }
    out[block] = (uint8_t)(end - block);
    return end;
}

static void check(const char *name, uint8_t type, uint16_t sequence, const void *payload,
                  size_t payload_size, const int16_t *counts, size_t count_size, int base, int step,
                  const char *expected)
{
    static uint8_t raw[TP_MAX_RAW], wire[TP_MAX_PACKET];
    static char hex[2 * TP_MAX_PACKET + 1];
    struct tp_header header = {.type = type, .sequence = sequence};
    size_t size = 0;

    memcpy(raw, &header, sizeof header);
    size += sizeof header;
    if (payload_size)
        memcpy(raw + size, payload, payload_size);
    size += payload_size;
    for (size_t i = 0; step && i < count_size; i++) { /* half a byte at a time */
        unsigned value = (unsigned)((counts[i] - base) / step) ^ (TP_SAMPLE_XOR & 0xFFFu);
        for (size_t nibble = 3 * i; nibble < 3 * i + 3; nibble++, value >>= 4) {
            uint8_t *byte = raw + size + nibble / 2;
            *byte = (uint8_t)(nibble % 2 ? *byte | (value & 15u) << 4 : value & 15u);
        }
    }
    size += step ? (3 * count_size + 1) / 2 : 0;
    for (size_t i = 0; !step && i < count_size; i++) {
        uint16_t word = (uint16_t)counts[i] ^ TP_SAMPLE_XOR;
        memcpy(raw + size, &word, sizeof word);
        size += sizeof word;
    }
    uint32_t crc = crc32(raw, size);
    memcpy(raw + size, &crc, sizeof crc);
    size_t length = cobs_encode(raw, size + sizeof crc, wire);
    wire[length++] = 0;

    for (size_t i = 0; i < length; i++)
        sprintf(hex + 2 * i, "%02x", wire[i]);
    if (strcmp(hex, expected) != 0) {
        printf("%s\n  expected %s\n  got      %s\n", name, expected, hex);
        failures++;
    }
}

int main(void)
{
#include "vectors.inc"
    return failures != 0;
}
