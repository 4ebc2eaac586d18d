// SPDX-License-Identifier: Apache-2.0

/* A byte that an interrupt puts into the RP2040's ring while the program waits for it. */
#include <signal.h>
#include <stdbool.h>
#include <sys/time.h>

#include "../../firmware/digitizer/rp2040/byte_ring.h"

static struct byte_ring ring;

static void interrupt(int number)
{
    (void)number;
    byte_ring_put(&ring, (const uint8_t *)"x", 1);
}

bool ring_is_seen(void);
bool ring_is_seen(void)
{
    const struct itimerval soon = {.it_value = {.tv_usec = 1000}};

    signal(SIGALRM, interrupt);
    setitimer(ITIMER_REAL, &soon, NULL);
    for (uint32_t i = 0; i < UINT32_MAX; i++)
        if (byte_ring_used(&ring))
            return true;
    return false;
}
