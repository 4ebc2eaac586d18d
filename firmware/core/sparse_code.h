// SPDX-License-Identifier: Apache-2.0

/* The octets of a node's sparse code: a shift register of 4 to 16 octets, each stepped octet the XOR of two
 * or four of them, so that an AVR takes some 50 cycles. See firmware/codes.md.
 */
#ifndef TACTILE_SPARSE_CODE_H
#define TACTILE_SPARSE_CODE_H

#include <stdbool.h>
#include <stdint.h>
#include <string.h>

/* With ROWS_ONLY, for 8 kB of flash, sparse codes and groups are left out. */
#ifdef ROWS_ONLY
#define SPARSE_CODES false
#else
#define SPARSE_CODES true
#endif

#define SPARSE_LEAST_DIGITS 4u
#define SPARSE_MOST_DIGITS 16u

struct sparse_code {
    uint8_t next;    /* number of the next octet, modulo SPARSE_MOST_DIGITS */
    uint8_t digits;  /* octets in the register */
    uint8_t taps[3]; /* where there is one only, two more that are equal and cancel */
};

/* digits: 4 to 16. */
static inline void sparse_init(struct sparse_code *code, uint8_t digits)
{
    static const uint8_t taps[][3] = {
        {1, 0, 0}, {2, 0, 0}, {1, 0, 0}, {1, 0, 0}, {2, 3, 4}, {4, 0, 0}, {3, 0, 0},
        {2, 0, 0}, {1, 4, 6}, {1, 3, 4}, {1, 3, 5}, {1, 0, 0}, {2, 3, 5},
    };

    code->digits = digits;
    memcpy(code->taps, taps[digits - SPARSE_LEAST_DIGITS], sizeof code->taps);
}

/* past: the register, of SPARSE_MOST_DIGITS: octet q at q modulo that. octets: the first ones of a frame. */
static inline void sparse_start(struct sparse_code *code, uint8_t *past, const uint8_t *octets)
{
    code->next = 0;
    memcpy(past, octets, code->digits);
}

/* The next octet. A 1 stands for a chip of -1. */
static inline uint8_t sparse_octet(struct sparse_code *code, uint8_t *past)
{
    const uint8_t all = SPARSE_MOST_DIGITS - 1;
    uint8_t next = code->next, octet = past[next];
    uint8_t more = past[(uint8_t)(next + code->taps[0]) & all] ^
                   past[(uint8_t)(next + code->taps[1]) & all] ^
                   past[(uint8_t)(next + code->taps[2]) & all];

    past[(uint8_t)(next + code->digits) & all] = octet ^ more;
    code->next = (uint8_t)(next + 1u) & all;
    return octet;
}

#endif
