// SPDX-License-Identifier: Apache-2.0

/* A ring of bytes between an interrupt and main(): one side puts, the other gets. */
#ifndef RP2040_BYTE_RING_H
#define RP2040_BYTE_RING_H

#include <stddef.h>
#include <stdint.h>

#define BYTE_RING_SIZE 1024u /* a power of two: 5 ms of the UART; USB makes its host wait */

struct byte_ring {
    volatile uint32_t put, got; /* total bytes, modulo 2³² */
    uint8_t bytes[BYTE_RING_SIZE];
};

static inline size_t byte_ring_used(const struct byte_ring *ring)
{
    return ring->put - ring->got;
}

static inline size_t byte_ring_room(const struct byte_ring *ring)
{
    return BYTE_RING_SIZE - byte_ring_used(ring);
}

/* Puts as many bytes as fit; returns their number. */
static inline size_t byte_ring_put(struct byte_ring *ring, const uint8_t *bytes, size_t size)
{
    size_t room = byte_ring_room(ring), put = ring->put;

    if (size > room)
        size = room;
    for (size_t i = 0; i < size; i++)
        ring->bytes[(put + i) % BYTE_RING_SIZE] = bytes[i];
    __asm__ volatile("" ::: "memory"); /* write the bytes before their number */
    ring->put = put + size;
    return size;
}

/* Gets up to `size` bytes; returns their number. */
static inline size_t byte_ring_get(struct byte_ring *ring, uint8_t *bytes, size_t size)
{
    size_t used = byte_ring_used(ring), got = ring->got;

    if (size > used)
        size = used;
    for (size_t i = 0; i < size; i++)
        bytes[i] = ring->bytes[(got + i) % BYTE_RING_SIZE];
    __asm__ volatile("" ::: "memory");
    ring->got = got + size;
    return size;
}

#endif
