// SPDX-License-Identifier: Apache-2.0

/* Sums over arrays of floats, kept in several partial sums: their rounding error is that of a few additions, and
 * they are added at once. Every processor gives the same bits. */
#ifndef TACTILE_SUMS_H
#define TACTILE_SUMS_H

#include <stddef.h>

#include "vectors.h"

#define SUMS_PART 1024 /* products that are added up in floats before they go into a double */

/* Sum of products of `size` values. */
INLINE double sums_dot(const float *some, const float *others, size_t size)
{
    double sum = 0;

    for (size_t begin = 0; begin < size; begin += SUMS_PART) {
        size_t end = size - begin < SUMS_PART ? size : begin + SUMS_PART, i = begin;
        floats8 sums[2] = {{0}, {0}};
        for (; i + 16 <= end; i += 16) {
            const floats8 *a = (const floats8 *)(some + i), *b = (const floats8 *)(others + i);
            sums[0] += a[0] * b[0];
            sums[1] += a[1] * b[1];
        }
        for (; i < end; i++)
            sums[0][0] += some[i] * others[i];
        for (size_t lane = 0; lane < 8; lane++)
            sum += (double)sums[0][lane] + (double)sums[1][lane];
    }
    return sum;
}

/* Sum of squares of `size` values. */
INLINE double sums_power(const float *values, size_t size)
{
    return sums_dot(values, values, size);
}

#endif
