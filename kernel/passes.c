// SPDX-License-Identifier: Apache-2.0

#include "passes.h"

#include <math.h>
#include <string.h>

#define LANES 8 /* sums that are kept apart, so that they can be added at once */

VECTORS double passes_mean_of(const float *chips, size_t count)
{
    double sums[LANES] = {0}, sum = 0;
    size_t i = 0;

    for (; i + LANES <= count; i += LANES)
        for (size_t lane = 0; lane < LANES; lane++)
            sums[lane] += (double)chips[i + lane];
    for (; i < count; i++)
        sum += (double)chips[i];
    for (size_t lane = 0; lane < LANES; lane++)
        sum += sums[lane];
    return sum / (double)count;
}

VECTORS void passes_flip(size_t count, const float *restrict chips, const float *restrict flips,
                         float *restrict flipped)
{
    for (size_t i = 0; i < count; i++)
        flipped[i] = chips[i] * flips[i];
}

VECTORS void passes_shift(size_t count, const float *chips, const float *restrict flips, float level, float *left)
{
    APART
    for (size_t i = 0; i < count; i++)
        left[i] = chips[i] - level * flips[i];
}

VECTORS double passes_product(size_t count, const float *restrict some, const float *restrict others)
{
    double sums[LANES] = {0}, sum = 0;
    size_t i = 0;

    for (; i + LANES <= count; i += LANES)
        for (size_t lane = 0; lane < LANES; lane++)
            sums[lane] += (double)some[i + lane] * (double)others[i + lane];
    for (; i < count; i++)
        sum += (double)some[i] * (double)others[i];
    for (size_t lane = 0; lane < LANES; lane++)
        sum += sums[lane];
    return sum;
}

VECTORS void passes_take(size_t count, const float *restrict chips, const float *restrict told,
                         const int32_t *restrict places, float onsager, const float *restrict flips, float level,
                         float *restrict left)
{
    for (size_t i = 0; i < count; i++)
        left[i] = chips[i] - told[places[i]] + onsager * left[i] - level * flips[i];
}

VECTORS void passes_average_loud(size_t rows, size_t bits, size_t step, const float *restrict sums, float scale,
                                 float *restrict loud)
{
    for (size_t i = 0; i < rows; i += LANES) {
        floats8 sum = {0};
        for (size_t bit = 0; bit < bits; bit++)
            sum += (floats8)(*(const ints8 *)(sums + bit * step + i) & INT32_MAX);
        *(floats8 *)(loud + i) = sum * scale;
    }
}

VECTORS void passes_believe(size_t rows, const float *restrict loud, const struct passes_odds *of,
                            float *restrict belief)
{
    const struct passes_odds odds = *of; /* the same for all, whatever is written */

    for (size_t i = 0; i < rows; i++)
        belief[i] = passes_share(loud[i], &odds);
}

/* Most eights of codes have none, and in others it is a guess who has. */
VECTORS size_t passes_list_above(size_t rows, const float *restrict values, float least, int32_t *restrict codes)
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

VECTORS void passes_say(size_t count, const int32_t *restrict codes, const float *restrict sums, float rise,
                        const float *restrict swings, float *restrict words, float *restrict straight,
                        float *restrict squares)
{
    for (size_t i = 0; i < count; i++) {
        float said = rise * sums[codes[i]];
        said = said < -1 ? -1 : said > 1 ? 1 : said;
        straight[i] += fabsf(said) < 1 ? 1.0f : 0.0f;
        squares[i] += said * said;
        words[i] = swings[i] * said;
    }
}

VECTORS void passes_say_hard(size_t count, const int32_t *restrict codes, const float *restrict sums,
                             const float *restrict loud, float *restrict words)
{
    for (size_t i = 0; i < count; i++)
        words[i] = copysignf(loud[codes[i]], sums[codes[i]]);
}

VECTORS double passes_distance(size_t count, const float *restrict some, const float *restrict others)
{
    double sums[LANES] = {0}, sum = 0;
    int differ = 0;
    size_t i = 0;

    for (; i + LANES <= count; i += LANES)
        for (size_t lane = 0; lane < LANES; lane++) {
            float a = some[i + lane], b = others[i + lane];
            differ |= !(a * b > 0);
            sums[lane] += (double)(a - b) * (double)(a - b);
        }
    for (; i < count; i++) {
        differ |= !(some[i] * others[i] > 0);
        sum += (double)(some[i] - others[i]) * (double)(some[i] - others[i]);
    }
    for (size_t lane = 0; lane < LANES; lane++)
        sum += sums[lane];
    return differ ? INFINITY : sum;
}

VECTORS void passes_add_squares(size_t rows, const float *restrict sums, float *restrict squares)
{
    for (size_t i = 0; i < rows; i++)
        squares[i] += sums[i] * sums[i];
}

VECTORS bool passes_any_above(size_t rows, const float *values, float most)
{
    int any = 0;

    for (size_t i = 0; i < rows; i++)
        any |= values[i] > most;
    return any;
}
