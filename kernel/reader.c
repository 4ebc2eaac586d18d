// SPDX-License-Identifier: Apache-2.0

#include "reader.h"

#include <errno.h>
#include <poll.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

static long now_ms(void)
{
    struct timespec now;

    clock_gettime(CLOCK_MONOTONIC, &now);
    return (long)now.tv_sec * 1000 + now.tv_nsec / 1000000;
}

ptrdiff_t reader_read(int file, uint8_t *bytes, size_t size, int timeout_ms, bool *had_waited)
{
    struct pollfd port = {.fd = file, .events = POLLIN};
    long end_ms = now_ms() + timeout_ms;
    size_t filled = 0;

    *had_waited = false;
    while (filled < size) {
        int ready = poll(&port, 1, 0);
        bool waited = ready > 0;
        long left_ms = end_ms - now_ms();
        if (left_ms < 0)
            break;
        if (!ready)
            ready = poll(&port, 1, (int)left_ms);
        if (!ready)
            break;
        ssize_t got = ready < 0 ? -1 : read(file, bytes + filled, size - filled);
        if (got < 0 && errno == EAGAIN)
            continue;
        if (got < 0 && errno == EINTR)
            break;
        if (got <= 0) {
            if (filled) /* the next call will tell */
                break;
            if (!got)
                errno = 0;
            return -1;
        }
        *had_waited = waited;
        filled += (size_t)got;
        if (memchr(bytes + filled - got, 0, (size_t)got))
            break;
    }
    return (ptrdiff_t)filled;
}
