// SPDX-License-Identifier: Apache-2.0

/* Reads packets, which somebody gives or a file descriptor does. It stands apart from the rest of the kernel,
 * which computes only; what it needs of POSIX, for descriptors, is left out where there is none, on Windows. */
#ifndef TACTILE_READER_H
#define TACTILE_READER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "frame_stream.h"

#define READER_SIZE 32768 /* bytes; a packet has at most half of that */

/* What is read, and for which stream. */
struct reader {
    struct stream *stream;
    struct scanner *scanner;    /* that of the stream */
    bool busy;                  /* a thread is in reader_next */
    double t_host;              /* s, CLOCK_MONOTONIC: of the bytes used last */
    bool backlog;               /* these had waited */
    int failure;                /* errno of a read that failed; -1: at the end of the file; 0: none did */
    uint8_t bytes[READER_SIZE];
};

/* Reads into bytes until a delimiter (0) has come, they are full, or `timeout_ms` have passed: so a reader
 * wakes once for a packet, however few bytes a tty gives at once. Returns how many were read; -1 and a
 * failure where the file cannot be read and nothing was, as on Windows. */
ptrdiff_t reader_read(struct reader *reader, int file, int timeout_ms);

/* Bytes that were read elsewhere, at t_host, s. False while others are not used up. */
bool reader_give(struct reader *reader, const uint8_t *bytes, size_t size, double t_host, bool backlog);

/* Goes on up to the next event: from the bytes that the stream was given and, if file is not negative, from
 * those that are read there within `timeout_ms`, an hour at most. STREAM_NEEDS_BYTES, too, after a failure. */
enum stream_event reader_next(struct reader *reader, int file, double timeout_ms);

#endif
