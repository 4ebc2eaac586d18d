// SPDX-License-Identifier: Apache-2.0

/* CRC-32 of IEEE 802.3, zlib and PNG. */
#ifndef TACTILE_CRC32_H
#define TACTILE_CRC32_H

#include <stddef.h>
#include <stdint.h>

/* CRC of any data followed by their own CRC, low byte first. */
#define CRC32_RESIDUE 0x2144DF1Cu

/* Continues a CRC over `size` bytes. crc: of the bytes before, 0 at the start.
 *
 * With CRC32_SMALL defined, crc32.c shifts bit by bit and needs no 1 kB table; it is slower. */
uint32_t crc32_update(uint32_t crc, const void *bytes, size_t size);

#endif
