// SPDX-License-Identifier: Apache-2.0

#include "crc.h"

#include <string.h>

/* Of bytes in a row of 8, from the last to the first (Kounavis and Berry 2005, "slicing by 8"). */
static uint32_t table[8][256];

void crc_prepare(void)
{
    for (uint32_t byte = 0; byte < 256; byte++) {
        uint32_t crc = byte;
        for (int bit = 0; bit < 8; bit++)
            crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320u : 0);
        table[0][byte] = crc;
    }
    for (int row = 1; row < 8; row++)
        for (int byte = 0; byte < 256; byte++) {
            uint32_t before = table[row - 1][byte];
            table[row][byte] = before >> 8 ^ table[0][before & 255];
        }
}

#if defined(__GNUC__) && defined(__x86_64__)
#include <immintrin.h>

#define HAS_CLMUL
#define LEAST_FOLDED 64 /* bytes */
#define FOLD __attribute__((target("pclmul,sse4.1")))

/* A block of 16 bytes moved on by a distance that the keys stand for, and what is there. */
FOLD static inline __m128i fold(__m128i block, __m128i keys, __m128i there)
{
    __m128i low = _mm_clmulepi64_si128(block, keys, 0x00);
    __m128i high = _mm_clmulepi64_si128(block, keys, 0x11);

    return _mm_xor_si128(_mm_xor_si128(low, high), there);
}

FOLD static inline __m128i block_at(const uint8_t *bytes)
{
    return _mm_loadu_si128((const __m128i *)bytes);
}

/* Folds whole blocks, four of them side by side, then reduces them (Gopal et al., "Fast CRC computation for
 * generic polynomials using PCLMULQDQ", Intel 2009, whose constants for this polynomial, reflected, these
 * are). size: a multiple of 16, LEAST_FOLDED or more. */
FOLD static uint32_t fold_blocks(uint32_t crc, const uint8_t *bytes, size_t size)
{
    const __m128i by_four = _mm_set_epi64x(0x01c6e41596, 0x0154442bd4);
    const __m128i by_one = _mm_set_epi64x(0x00ccaa009e, 0x01751997d0);
    const __m128i to_64 = _mm_set_epi64x(0, 0x0163cd6124);
    const __m128i polynomial = _mm_set_epi64x(0x01f7011641, 0x01db710641);
    const __m128i low_words = _mm_setr_epi32(~0, 0, ~0, 0);
    __m128i sum = _mm_xor_si128(block_at(bytes), _mm_cvtsi32_si128((int)crc));
    __m128i second = block_at(bytes + 16), third = block_at(bytes + 32), fourth = block_at(bytes + 48);

    for (bytes += 64, size -= 64; size >= 64; bytes += 64, size -= 64) {
        sum = fold(sum, by_four, block_at(bytes));
        second = fold(second, by_four, block_at(bytes + 16));
        third = fold(third, by_four, block_at(bytes + 32));
        fourth = fold(fourth, by_four, block_at(bytes + 48));
    }
    sum = fold(fold(fold(sum, by_one, second), by_one, third), by_one, fourth);
    for (; size; bytes += 16, size -= 16)
        sum = fold(sum, by_one, block_at(bytes));
    sum = _mm_xor_si128(_mm_srli_si128(sum, 8), _mm_clmulepi64_si128(sum, by_one, 0x10));
    sum = _mm_xor_si128(_mm_srli_si128(sum, 4),
                        _mm_clmulepi64_si128(_mm_and_si128(sum, low_words), to_64, 0x00));
    __m128i quotient = _mm_clmulepi64_si128(_mm_and_si128(sum, low_words), polynomial, 0x10);
    quotient = _mm_clmulepi64_si128(_mm_and_si128(quotient, low_words), polynomial, 0x00);
    return (uint32_t)_mm_extract_epi32(_mm_xor_si128(sum, quotient), 1);
}
#endif

uint32_t crc_of(const uint8_t *bytes, size_t size)
{
    uint32_t crc = UINT32_MAX, low, high;

#if defined(HAS_CLMUL)
    if (size >= LEAST_FOLDED && __builtin_cpu_supports("pclmul") && __builtin_cpu_supports("sse4.1")) {
        size_t folded = size & ~(size_t)15;
        crc = fold_blocks(crc, bytes, folded);
        bytes += folded;
        size -= folded;
    }
#endif
    for (; size >= 8; size -= 8, bytes += 8) {
        memcpy(&low, bytes, 4);
        memcpy(&high, bytes + 4, 4);
        low ^= crc;
        crc = table[7][low & 255] ^ table[6][low >> 8 & 255] ^ table[5][low >> 16 & 255] ^
              table[4][low >> 24] ^ table[3][high & 255] ^ table[2][high >> 8 & 255] ^
              table[1][high >> 16 & 255] ^ table[0][high >> 24];
    }
    while (size--)
        crc = crc >> 8 ^ table[0][(crc ^ *bytes++) & 255];
    return ~crc;
}
