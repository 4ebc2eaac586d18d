// SPDX-License-Identifier: Apache-2.0

#include "crc32.h"

#if defined(CRC32_SMALL)

#define POLYNOMIAL 0xEDB88320u

static inline uint32_t shift_byte(uint32_t crc, uint8_t byte)
{
    crc ^= byte;
    for (uint8_t bit = 0; bit < 8; bit++)
        crc = crc & 1u ? crc >> 1 ^ POLYNOMIAL : crc >> 1;
    return crc;
}

#else

/* The CRC is linear: a byte's entry is the XOR of the entries of its set bits. */
#define ENTRY(byte)                                                                       \
    (((byte) & 0x01 ? 0x77073096u : 0u) ^ ((byte) & 0x02 ? 0xEE0E612Cu : 0u) ^            \
     ((byte) & 0x04 ? 0x076DC419u : 0u) ^ ((byte) & 0x08 ? 0x0EDB8832u : 0u) ^            \
     ((byte) & 0x10 ? 0x1DB71064u : 0u) ^ ((byte) & 0x20 ? 0x3B6E20C8u : 0u) ^            \
     ((byte) & 0x40 ? 0x76DC4190u : 0u) ^ ((byte) & 0x80 ? 0xEDB88320u : 0u))
#define ENTRIES_4(byte) ENTRY(byte), ENTRY((byte) + 1), ENTRY((byte) + 2), ENTRY((byte) + 3)
#define ENTRIES_16(byte) \
    ENTRIES_4(byte), ENTRIES_4((byte) + 4), ENTRIES_4((byte) + 8), ENTRIES_4((byte) + 12)
#define ENTRIES_64(byte) \
    ENTRIES_16(byte), ENTRIES_16((byte) + 16), ENTRIES_16((byte) + 32), ENTRIES_16((byte) + 48)

static const uint32_t table[256] = {
    ENTRIES_64(0), ENTRIES_64(64), ENTRIES_64(128), ENTRIES_64(192),
};

static inline uint32_t shift_byte(uint32_t crc, uint8_t byte)
{
    return crc >> 8 ^ table[(crc ^ byte) & 0xFFu];
}

#endif

uint32_t crc32_update(uint32_t crc, const void *bytes, size_t size)
{
    const uint8_t *byte = bytes, *end = byte + size;

    crc = ~crc;
    while (byte != end)
        crc = shift_byte(crc, *byte++);
    return ~crc;
}
