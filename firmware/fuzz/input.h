// Copyright 2026 tactile_cdma maintainers
//
// Licensed under the Apache License, Version 2.0 (the "License");
// you may not use this file except in compliance with the License.
// You may obtain a copy of the License at
//
//     http://www.apache.org/licenses/LICENSE-2.0
//
// Unless required by applicable law or agreed to in writing, software
// distributed under the License is distributed on an "AS IS" BASIS,
// WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
// See the License for the specific language governing permissions and
// limitations under the License.

/* A fuzzed input, read number by number; after its end all are 0. */
#ifndef FUZZ_INPUT_H
#define FUZZ_INPUT_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

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

#endif
