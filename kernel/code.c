// SPDX-License-Identifier: Apache-2.0

#include "code.h"

#include "vectors.h"

VECTORS static void flip(const float *flips, size_t size, const float *from, float *to)
{
    for (size_t i = 0; i < size; i++)
        to[i] = from[i] * flips[i];
}

void code_rows(const struct code *code, const float *chips, float *rows)
{
    if (code->flips) {
        flip(code->flips, code->bits * code->order, chips, rows);
        chips = rows;
    }
    transform_multiply(code->correlate, chips, rows, code->bits);
}

void code_chips(const struct code *code, const float *rows, float *chips)
{
    transform_multiply(code->spread, rows, chips, code->bits);
    if (code->flips)
        flip(code->flips, code->bits * code->order, chips, chips);
}
