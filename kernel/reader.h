// SPDX-License-Identifier: Apache-2.0

/* Reads a stream of packets from a file descriptor. */
#ifndef TACTILE_READER_H
#define TACTILE_READER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define READER_SIZE 32768 /* bytes; a packet has at most half of that */

/* Reads until a delimiter (0) has come, `size` bytes are there, or `timeout_ms` have passed: so a reader
 * wakes once for a packet, however few bytes a tty gives at once. Returns the bytes that were read; -1
 * with errno where it cannot be read and nothing was; errno is 0 at the end of the file. had_waited:
 * whether the last bytes were there before they were waited for. */
ptrdiff_t reader_read(int file, uint8_t *bytes, size_t size, int timeout_ms, bool *had_waited);

#endif
