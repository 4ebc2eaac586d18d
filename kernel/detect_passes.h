// SPDX-License-Identifier: Apache-2.0

/* What `detect.c` does with all values at once: over the levels of all codes, of those that are listed, or over all
 * chips. */
#ifndef TACTILE_DETECT_PASSES_H
#define TACTILE_DETECT_PASSES_H

#include <math.h>

#include "detect.h"
#include "sums.h"

#define LANES 8 /* sums that are kept apart, so that they can be added at once */

VECTORS static void flip(size_t count, const float *restrict chips, const float *restrict flips,
                         float *restrict flipped)
{
    for (size_t i = 0; i < count; i++)
        flipped[i] = chips[i] * flips[i];
}

VECTORS static double power_of(const float *values, size_t count)
{
    return sums_power(values, count);
}

/* Takes off the offset of chips that are flipped back, which is returned. */
VECTORS static double take_offset(size_t count, const float *restrict flips, float *restrict left)
{
    double mean = sums_dot(left, flips, count) / (double)count;
    float offset = (float)mean;

    for (size_t i = 0; i < count; i++)
        left[i] -= offset * flips[i];
    return mean;
}

/* What words leave of chips: told are the words' in all places, onsager the share of what was left before. */
VECTORS static void take(size_t count, const float *restrict chips, const float *restrict told,
                         const int32_t *restrict places, float onsager, const float *restrict flips,
                         float offset, float *restrict left)
{
    for (size_t i = 0; i < count; i++)
        left[i] = chips[i] - told[places[i]] + onsager * left[i] - offset * flips[i];
}

/* Means of |r| over the bits, scaled; sums: `step` values from bit to bit. */
VECTORS static void average_loud(size_t rows, size_t bits, size_t step, const float *restrict sums,
                                 float scale, float *restrict loud)
{
    for (size_t i = 0; i < rows; i += LANES) {
        floats8 sum = {0};
        for (size_t bit = 0; bit < bits; bit++)
            sum += (floats8)(*(const ints8 *)(sums + bit * step + i) & INT32_MAX);
        *(floats8 *)(loud + i) = sum * scale;
    }
}

/* How the share of a word that is believed follows from its mean |r|: from the logarithm of its odds. */
struct odds {
    float per, bits, half, odds, span;
};

VECTORS static void believe(size_t rows, const float *restrict loud, const struct odds *of,
                            float *restrict belief)
{
    const struct odds odds = *of; /* the same for all, whatever is written */
    const float turn = 2 * 0.69314718f;

    for (size_t i = 0; i < rows; i++) {
        float u = odds.per * loud[i];
        /* log cosh u is u²/2 for small ones and u − log 2 for large ones: a parabola up to the line. */
        float log_cosh = u < turn ? u * u / (2 * turn) : u - turn / 2;
        float share = 0.5f + (odds.bits * (log_cosh - odds.half) + odds.odds) / odds.span;
        belief[i] = share < 0 ? 0 : share > 1 ? 1 : share;
    }
}

/* Lists the codes that have more than the least; returns how many. Most eights of codes have none, and in
 * others it is a guess who has. */
VECTORS static size_t list_above(size_t rows, const float *restrict values, float least,
                                 int32_t *restrict codes)
{
    const floats8 limit = (floats8){0} + least;
    size_t count = 0;

    for (size_t first = 0; first < rows; first += LANES) {
        const ints8 above = *(const floats8 *)(values + first) > limit;
        uint64_t pairs[LANES / 2];
        memcpy(pairs, &above, sizeof pairs);
        bool any = pairs[0] | pairs[1] | pairs[2] | pairs[3];
        for (size_t i = 0; any && i < LANES; i++) {
            codes[count] = (int32_t)(first + i);
            count += values[first + i] > least;
        }
    }
    return count;
}

/* The soft words of one bit of those that will be taken off, by levels that rise to ±1 and the amplitude of
 * a node, V. In the detector's `straight` and `squares`: by how many levels they follow, and those of the
 * bits. */
VECTORS static void say(const struct detector *detector, const float *restrict sums, float rise, float swing,
                        float *restrict words)
{
    const size_t count = detector->next.count;
    const int32_t *restrict codes = detector->next.codes;
    const float *restrict belief = detector->belief;
    float *restrict straight = detector->straight, *restrict squares = detector->squares;

    for (size_t i = 0; i < count; i++) {
        float said = rise * sums[codes[i]];
        said = said < -1 ? -1 : said > 1 ? 1 : said;
        straight[i] += fabsf(said) < 1 ? 1.0f : 0.0f;
        squares[i] += said * said;
        words[i] = swing * belief[i] * said;
    }
}

/* The hard words of one bit. */
VECTORS static void say_hard(size_t count, const int32_t *restrict codes, const float *restrict sums,
                             const float *restrict loud, float *restrict words)
{
    for (size_t i = 0; i < count; i++)
        words[i] = copysignf(loud[codes[i]], sums[codes[i]]);
}

/* Sum of squares of the differences; INFINITY if any two have other signs, or are 0. */
static double distance(size_t count, const float *restrict some, const float *restrict others)
{
    double sum = 0;
    int differ = 0;

    for (size_t i = 0; i < count; i++) {
        differ |= !(some[i] * others[i] > 0);
        sum += (double)(some[i] - others[i]) * (double)(some[i] - others[i]);
    }
    return differ ? INFINITY : sum;
}

#endif
