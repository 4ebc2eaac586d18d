// SPDX-License-Identifier: Apache-2.0

/* CRC-32 of IEEE 802.3, zlib and PNG. */
#ifndef TACTILE_CRC32_H
#define TACTILE_CRC32_H

#include <stddef.h>
#include <stdint.h>

/* The CRC of any bytes that are followed by their own CRC, low byte first. */
#define CRC32_RESIDUE 0x2144DF1Cu

/* The CRC of some bytes and `size` more; crc: of those before, 0 where there are none.
 *
 * With CRC32_SMALL defined, crc32.c does without its table: a tenth of the speed, but no kilobyte. */
uint32_t crc32_update(uint32_t crc, const void *bytes, size_t size);

#endif
