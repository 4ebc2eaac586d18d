// SPDX-License-Identifier: Apache-2.0

#include "reference.h"

#include <string.h>

#define CRC_SIZE sizeof(uint32_t)
#define HEADER_SIZE sizeof(struct tp_header)

/* CRC-32 of four bits: the polynomial, where they are 8, and its shifts. */
static const uint32_t table[16] = {
    0x00000000, 0x1DB71064, 0x3B6E20C8, 0x26D930AC, 0x76DC4190, 0x6B6B51F4, 0x4DB26158, 0x5005713C,
    0xEDB88320, 0xF00F9344, 0xD6D6A3E8, 0xCB61B38C, 0x9B64C2B0, 0x86D3D2D4, 0xA00AE278, 0xBDBDF21C,
};

uint32_t framing_crc(const uint8_t *bytes, size_t size)
{
    uint32_t crc = UINT32_MAX;

    for (size_t i = 0; i < size; i++) {
        crc ^= bytes[i];
        crc = crc >> 4 ^ table[crc & 15];
        crc = crc >> 4 ^ table[crc & 15];
    }
    return ~crc;
}

size_t framing_unwrap(const uint8_t *run, size_t size, uint8_t *body)
{
    size_t out = 0, in = 0;
    uint32_t crc;

    if (size > FRAMING_MAX_RUN)
        return 0;
    while (in < size) {
        size_t block = run[in];
        if (in + block > size)
            return 0;
        memcpy(body + out, run + in + 1, block - 1);
        out += block - 1;
        in += block;
        if (block != 255 && in < size)
            body[out++] = 0;
    }
    if (out < HEADER_SIZE + CRC_SIZE)
        return 0;
    memcpy(&crc, body + out - CRC_SIZE, CRC_SIZE);
    return crc == framing_crc(body, out - CRC_SIZE) ? out - CRC_SIZE : 0;
}

size_t framing_wrap(uint8_t *body, size_t size, uint8_t *wire)
{
    uint32_t crc = framing_crc(body, size);
    size_t block = 0, out = 1;

    memcpy(body + size, &crc, CRC_SIZE);
    size += CRC_SIZE;
    for (size_t in = 0; in < size; in++) {
        if (out - block == 255) {
            wire[block] = 255;
            block = out++;
        }
        if (body[in]) {
            wire[out++] = body[in];
        } else {
            wire[block] = (uint8_t)(out - block);
            block = out++;
        }
    }
    wire[block] = (uint8_t)(out - block);
    wire[out++] = 0;
    return out;
}
