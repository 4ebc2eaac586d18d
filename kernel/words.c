// SPDX-License-Identifier: Apache-2.0

#include "words.h"

#include <math.h>

#include "vectors.h"

#define BLOCK 128 /* nodes that are measured together: their sums stay in the nearest cache */

struct words words_in(uint8_t *memory, size_t nodes)
{
    float *floats = (float *)(void *)memory;
    uint8_t *flags = memory + 16 * nodes;

    return (struct words){.amplitude = floats,
                          .rho = floats + nodes,
                          .margin = floats + 2 * nodes,
                          .codes = (int32_t *)(void *)(floats + 3 * nodes),
                          .active = flags,
                          .doubtful = flags + nodes,
                          .doubled = flags + 2 * nodes,
                          .odd = flags + 3 * nodes,
                          .faint = flags + 4 * nodes};
}

/* ---- measure ----------------------------------------------------------------------------------- */

INLINE void measure_block(const float *levels, size_t step, size_t bits, size_t nodes,
                          const struct words_measures *measures, size_t first)
{
    float sum[BLOCK] = {0}, least[BLOCK], most[BLOCK] = {0}, squares[BLOCK] = {0};
    int32_t signs[BLOCK] = {0}, place[BLOCK] = {0};

    for (size_t i = 0; i < nodes; i++)
        least[i] = INFINITY;
    for (size_t bit = 0; bit < bits; bit++, levels += step)
        for (size_t i = 0; i < nodes; i++) {
            float level = fabsf(levels[i]);
            sum[i] += level;
            squares[i] += level * level;
            place[i] = level < least[i] ? (int32_t)bit : place[i];
            least[i] = level < least[i] ? level : least[i];
            most[i] = level > most[i] ? level : most[i];
            signs[i] = signs[i] << 1 | (levels[i] > 0);
        }
    for (size_t i = 0; i < nodes; i++) {
        measures->amplitude[first + i] = sum[i] * (float)(1.0 / (double)bits);
        measures->weakest[first + i] = least[i];
        measures->strongest[first + i] = most[i];
        measures->squares[first + i] = squares[i];
        measures->signs[first + i] = signs[i];
        measures->weakest_bit[first + i] = place[i];
    }
}

VECTORS void words_measure(const float *levels, size_t step, size_t bits, size_t nodes,
                           const struct words_measures *measures)
{
    size_t first = 0;

    for (; first + BLOCK <= nodes; first += BLOCK)
        measure_block(levels + first, step, bits, BLOCK, measures, first);
    if (first < nodes)
        measure_block(levels + first, step, bits, nodes - first, measures, first);
}

float words_usual(const float *amplitude, size_t nodes, float loud_share, float *loudest)
{
    float first = 0, second = 0, third = 0; /* loudest ones */

    for (size_t i = 0; i < nodes; i++) {
        float level = amplitude[i];
        if (level > third) {
            third = fminf(level, second);
            second = fminf(fmaxf(level, second), first);
            first = fmaxf(level, first);
        }
    }
    *loudest = first;
    return nodes >= 3 && third > loud_share * first ? second : first;
}

/* ---- decide ------------------------------------------------------------------------------------ */

INLINE int odd_of(uint32_t word)
{
    word ^= word >> 16;
    word ^= word >> 8;
    word ^= word >> 4;
    word ^= word >> 2;
    return (int)((word ^ word >> 1) & 1);
}

/* Without branches, and with pointers that are known to differ, so that it is done for many nodes at once: `parity`
 * is a constant where this is inlined. */
INLINE void decide_by(const bool parity, const struct words_measures *measures, const struct words_code *code,
                      const float *restrict expected, float per_noise, const struct words_limits limit,
                      const struct words *words)
{
    const size_t nodes = code->nodes;
    const unsigned bits = code->bits;
    const int32_t *restrict sign_mask = code->sign_mask;
    const float *restrict amplitudes = measures->amplitude, *restrict least = measures->weakest;
    const float *restrict most = measures->strongest;
    const int32_t *restrict signs = measures->signs, *restrict weakest_bit = measures->weakest_bit;
    const uint8_t *restrict active = words->active;
    float *restrict rhos = words->rho, *restrict margins = words->margin;
    int32_t *restrict codes = words->codes;
    uint8_t *restrict doubtful = words->doubtful, *restrict doubled = words->doubled, *restrict odd = words->odd;

    APART
    for (size_t i = 0; i < nodes; i++) {
        float amplitude = amplitudes[i], two = limit.two * expected[i], rho = amplitude * per_noise;
        float margin = least[i] / (amplitude < 1e-30f ? 1e-30f : amplitude);
        int uneven = (margin < limit.clear_margin) | (most[i] > (2 - limit.clear_margin) * amplitude), is_odd = 0;
        int doubt = (rho < limit.low_rho) | (margin < limit.low_margin) | ((rho > limit.even_rho) & uneven);
        uint32_t word = (uint32_t)(signs[i] ^ sign_mask[i]);
        if (parity) {
            is_odd = odd_of(word);
            uint32_t place = (bits - 1 - (uint32_t)weakest_bit[i]) & 31;
            word = (word ^ (uint32_t)is_odd << place) >> 1;
            doubt |= is_odd;
        }
        int cancelling = doubt & (least[i] < limit.low_margin * expected[i]);
        int three = (amplitude > limit.shared * expected[i]) & (rho > limit.clear_rho) &
                    (least[i] < limit.lower * most[i]);
        int twice = (cancelling | three) & (most[i] > two);
        codes[i] = active[i] ? (int32_t)word : 0;
        rhos[i] = rho;
        margins[i] = margin;
        doubtful[i] = (uint8_t)(active[i] & (doubt | twice | (amplitude > two)));
        doubled[i] = (uint8_t)(active[i] & twice);
        odd[i] = (uint8_t)(active[i] & is_odd);
    }
}

VECTORS void words_decide(const struct words_measures *measures, const struct words_code *code, const float *expected,
                          float per_noise, const struct words_limits *limits, const struct words *words)
{
    if (code->parity)
        decide_by(true, measures, code, expected, per_noise, *limits, words);
    else
        decide_by(false, measures, code, expected, per_noise, *limits, words);
}
