// SPDX-License-Identifier: Apache-2.0

/* Shared by all harnesses: reads an input and reports faults. */
#ifndef FUZZ_FUZZ_H
#define FUZZ_FUZZ_H

#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* A fuzzed input, read number by number; beyond its end all numbers are 0. */

struct input {
    const uint8_t *bytes;
    size_t left;
};

/* Up to `most` of its next bytes; returns how many. */
static inline size_t input_bytes(struct input *input, const uint8_t **bytes, size_t most)
{
    size_t size = most < input->left ? most : input->left;

    *bytes = input->bytes;
    input->bytes += size;
    input->left -= size;
    return size;
}

static inline uint64_t input_number(struct input *input, size_t size)
{
    const uint8_t *bytes;
    uint64_t number = 0;

    size = input_bytes(input, &bytes, size);
    memcpy(&number, bytes, size);
    return number;
}

static inline uint8_t input_u8(struct input *input)
{
    return (uint8_t)input_number(input, 1);
}

static inline uint16_t input_u16(struct input *input)
{
    return (uint16_t)input_number(input, 2);
}

static inline uint32_t input_u32(struct input *input)
{
    return (uint32_t)input_number(input, 4);
}

/* Asserts what the firmware must do: on a fault the harness prints its kind, as in the sums of
 * `make torture`, and aborts. */

enum fault { WRONG_VALUE, UNCOUNTED_LOSS };

#define MUST(condition, fault)                                                         \
    do {                                                                               \
        if (!(condition)) {                                                            \
            fprintf(stderr, "%s:%d: %s: %s\n", __FILE__, __LINE__,                     \
                    (fault) == WRONG_VALUE ? "wrong value" : "uncounted loss", #condition); \
            abort();                                                                   \
        }                                                                              \
    } while (0)

/* Memory of an input, of its exact size, so that nothing is read beyond; it begins as zeros. */
static void *blocks[64];
static size_t block_count;

static inline void *own(size_t count, size_t size)
{
    return blocks[block_count++] = calloc(count + !count, size);
}

static inline void free_all(void)
{
    while (block_count)
        free(blocks[--block_count]);
}

#endif
