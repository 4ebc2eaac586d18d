// SPDX-License-Identifier: Apache-2.0

/* CRC-32 of IEEE 802.3, as zlib's: in C, since every byte of the stream passes through it. By carry-less
 * multiplication where the processor has it, else by tables of eight bytes at a time. */
#ifndef TACTILE_CRC_H
#define TACTILE_CRC_H

#include <stddef.h>
#include <stdint.h>

/* Prepares the tables; before the first CRC. */
void crc_prepare(void);
uint32_t crc_of(const uint8_t *bytes, size_t size);

#endif
