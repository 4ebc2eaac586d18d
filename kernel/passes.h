// SPDX-License-Identifier: Apache-2.0

/* Passes over the levels of all codes, those that are listed, or all chips, for detect.h. In C because a turn has ten
 * of them, each too short for numpy to be worth its call. Where many values are added, sums are in double, and in the
 * same order on every processor. */
#ifndef TACTILE_PASSES_H
#define TACTILE_PASSES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "vectors.h"

/* ---- chips --------------------------------------------------------------------------------------- */

double passes_mean_of(const float *chips, size_t count);
double passes_product(size_t count, const float *restrict some, const float *restrict others);
void passes_flip(size_t count, const float *restrict chips, const float *restrict flips, float *restrict flipped);

/* Chips, which may be `left`, without the level. */
void passes_shift(size_t count, const float *chips, const float *restrict flips, float level, float *left);

/* What words leave of chips: told are the words' in all places, onsager the share of what was left before. */
void passes_take(size_t count, const float *restrict chips, const float *restrict told, const int32_t *restrict places,
                 float onsager, const float *restrict flips, float level, float *restrict left);

/* ---- all codes ----------------------------------------------------------------------------------- */

/* Means of |r| over the bits, scaled; sums: so many values from bit to bit. */
void passes_average_loud(size_t rows, size_t bits, size_t step, const float *restrict sums, float scale,
                         float *restrict loud);
void passes_add_squares(size_t rows, const float *restrict sums, float *restrict squares);
bool passes_any_above(size_t rows, const float *values, float most);

/* Lists the codes that have more than the least; returns how many. */
size_t passes_list_above(size_t rows, const float *restrict values, float least, int32_t *restrict codes);

/* How the share of a word that is believed follows from its mean |r|; as _belief in detect.py. */
struct passes_odds {
    float per, bits, half, odds, span;
};

INLINE float passes_share(float loud, const struct passes_odds *of)
{
    const float turn = 2 * 0.69314718f;
    float u = of->per * loud;
    float log_cosh = u < turn ? u * u / (2 * turn) : u - turn / 2;
    float share = 0.5f + (of->bits * (log_cosh - of->half) + of->odds) / of->span;

    return share < 0 ? 0 : share > 1 ? 1 : share;
}

void passes_believe(size_t rows, const float *restrict loud, const struct passes_odds *of, float *restrict belief);

/* ---- listed codes -------------------------------------------------------------------------------- */

/* The soft words of one bit. straight, squares: by how many levels they follow, and those of the bits. */
void passes_say(size_t count, const int32_t *restrict codes, const float *restrict sums, float rise,
                const float *restrict swings, float *restrict words, float *restrict straight, float *restrict squares);

/* The hard words of one bit. */
void passes_say_hard(size_t count, const int32_t *restrict codes, const float *restrict sums,
                     const float *restrict loud, float *restrict words);

/* Sum of squares of the differences; INFINITY if any two have other signs, or are 0. */
double passes_distance(size_t count, const float *restrict some, const float *restrict others);

#endif
