// SPDX-License-Identifier: Apache-2.0

#include "reader.h"

#include <errno.h>

#define HOUR_MS 3.6e6

#if defined(_WIN32)

/* Ports are no files there: whoever has one reads it, and gives what came. */
static double now_s(void)
{
    return 0;
}

ptrdiff_t reader_read(struct reader *reader, int file, int timeout_ms)
{
    (void)file, (void)timeout_ms;
    reader->failure = ENOSYS;
    return -1;
}

#else

#include <poll.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#define AT_END (-1) /* in place of errno */

static double now_s(void)
{
    struct timespec now;

    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + (double)now.tv_nsec * 1e-9;
}

static long now_ms(void)
{
    return (long)(now_s() * 1e3);
}

/* Waits until there is something to read, as poll tells; 0 once the time is over. waited: it was there before. */
static int wait_for(struct pollfd *port, long end_ms, bool *waited)
{
    int ready = poll(port, 1, 0);
    long left_ms = end_ms - now_ms();

    *waited = ready > 0;
    if (left_ms < 0)
        return 0;
    return ready ? ready : poll(port, 1, (int)left_ms);
}

ptrdiff_t reader_read(struct reader *reader, int file, int timeout_ms)
{
    struct pollfd port = {.fd = file, .events = POLLIN};
    long end_ms = now_ms() + timeout_ms;
    size_t filled = 0;

    reader->backlog = false;
    reader->failure = 0;
    while (filled < READER_SIZE) {
        bool waited;
        int ready = wait_for(&port, end_ms, &waited);
        if (!ready)
            break;
        ssize_t got = ready < 0 ? -1 : read(file, reader->bytes + filled, READER_SIZE - filled);
        if (got < 0 && errno == EAGAIN)
            continue;
        if (got < 0 && errno == EINTR)
            break;
        if (got <= 0) {
            if (filled) /* the next call will tell */
                break;
            reader->failure = got ? errno : AT_END;
            return -1;
        }
        reader->backlog = waited;
        filled += (size_t)got;
        if (memchr(reader->bytes + filled - got, 0, (size_t)got))
            break;
    }
    return (ptrdiff_t)filled;
}

#endif

bool reader_give(struct reader *reader, const uint8_t *bytes, size_t size, double t_host, bool backlog)
{
    if (!stream_give(reader->stream, bytes, size, t_host, backlog))
        return false;
    reader->t_host = t_host;
    reader->backlog = backlog;
    return true;
}

enum stream_event reader_next(struct reader *reader, int file, double timeout_ms)
{
    double left_ms = timeout_ms < HOUR_MS ? timeout_ms : HOUR_MS, end_s = now_s() + left_ms * 1e-3;
    enum stream_event event = stream_next(reader->stream);
    ptrdiff_t size = 1;

    reader->failure = 0;
    /* Once at least, and not for ever if bytes come that are no packets. */
    while (event == STREAM_NEEDS_BYTES && file >= 0 && size > 0 && left_ms >= 0) {
        size = reader_read(reader, file, (int)left_ms);
        if (size > 0) {
            reader->t_host = now_s();
            stream_give(reader->stream, reader->bytes, (size_t)size, reader->t_host, reader->backlog);
            event = stream_next(reader->stream);
            left_ms = (end_s - reader->t_host) * 1e3;
        }
    }
    return event;
}
