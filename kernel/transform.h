// SPDX-License-Identifier: Apache-2.0

/* Product of vectors with a Kronecker product of Hadamard matrices: 2 ⊗ 2 ⊗ … ⊗ P ⊗ Q ⊗ …, the
 * first factor varying slowest; P, Q, … are dense matrices of ±1.
 *
 * A factor of 2 is a butterfly; three of them are done in one pass over memory. A dense factor takes
 * its inputs four at a time, forms their 16 sums ±a ±b ±c ±d once, and every output looks up one sum
 * of each four: P²/4 additions instead of P² (Arlazarov et al. 1970, "four Russians").
 *
 * All additions are made in the same order whatever the width of the vector registers: results are the same bits
 * with 1, 4 and 8 lanes. */
#ifndef TACTILE_TRANSFORM_H
#define TACTILE_TRANSFORM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define TRANSFORM_MOST_DENSE 1024  /* order of a dense factor; MOST_FACTOR in codes.py */
#define TRANSFORM_MOST_FACTORS 8   /* dense ones */
#define TRANSFORM_MOST_ORDER 65536 /* of the product */

struct transform;

/* A transform of `twos` factors of 2 and `count` dense ones of these orders, which are multiples of 4;
 * matrices[f][j·orders[f] + i] is the sign with which input i adds to output j. lanes: 1, 4, 8 or 0, the most that
 * this processor has. NULL: out of memory, orders beyond the limits, or lanes that this build or processor lacks. */
struct transform *transform_new(unsigned twos, size_t count, const size_t *orders,
                                const int8_t *const *matrices, float scale, unsigned lanes);
void transform_free(struct transform *transform);
size_t transform_order(const struct transform *transform);

/* The product of `count` vectors of transform_order() values, times the scale. `from` and `to` may be the same, but
 * not overlap otherwise. */
void transform_multiply(const struct transform *transform, const float *from, float *to, size_t count);

/* The most lanes that transform_new accepts here. */
unsigned transform_lanes(void);

#endif
