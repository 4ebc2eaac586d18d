// SPDX-License-Identifier: Apache-2.0

/* Packets ↔ bytes a second time, from docs/protocol.md and as plainly as can be: what the core's
 * framing is held against. */
#ifndef FUZZ_FRAMING_H
#define FUZZ_FRAMING_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "tactile_protocol.h"

#define FRAMING_MAX_RUN (TP_MAX_PACKET - 1)

uint32_t framing_crc(const uint8_t *bytes, size_t size);

/* The packet in a run of bytes between two zeros. body: room for FRAMING_MAX_RUN bytes; gets header
 * and payload. Returns their size, or 0 where the run is no packet. */
size_t framing_unwrap(const uint8_t *run, size_t size, uint8_t *body);

/* A body with its CRC, COBS and delimiter. wire: room for TP_MAX_PACKET bytes; body: for 4 more than
 * its size. Returns the size. */
size_t framing_wrap(uint8_t *body, size_t size, uint8_t *wire);

#endif
