// SPDX-License-Identifier: Apache-2.0

/* The octets by which all nodes that scramble flip their chips: Marsaglia's xorshift in octets, so that
 * an AVR takes 30 cycles. See firmware/codes.md. From state 0 all octets are 0 and flip nothing.
 */
#ifndef TACTILE_SCRAMBLER_H
#define TACTILE_SCRAMBLER_H

#include <stdint.h>
#include <string.h>

struct scrambler {
    uint8_t past[4]; /* the last octets, the oldest first */
};

/* state: the octets before the first one, the oldest in the lowest bits. */
static inline void scrambler_start(struct scrambler *s, uint32_t state)
{
    memcpy(s->past, &state, sizeof state);
}

/* The next octet. */
static inline uint8_t scrambler_octet(struct scrambler *s)
{
    uint8_t oldest = s->past[0], newest = s->past[3];

    oldest ^= (uint8_t)(oldest << 1);
    newest ^= (uint8_t)(newest >> 3) ^ oldest ^ (uint8_t)(oldest >> 1);
    s->past[0] = s->past[1];
    s->past[1] = s->past[2];
    s->past[2] = s->past[3];
    s->past[3] = newest;
    return newest;
}

#endif
