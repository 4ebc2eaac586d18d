// SPDX-License-Identifier: Apache-2.0

#include "transform.h"

#include <stdlib.h>
#include <string.h>

#include "vectors.h"

#define COLUMNS 16 /* of a dense product that are done together */
#define GROUPS 16  /* fours of inputs whose sums are held at once: 16 kB, in the nearest cache */

#define CACHED 4096 /* values */

struct dense {
    size_t order, stride; /* stride: of its inputs, the product of the orders after it */
    uint8_t *sums;        /* (order / 4, order): offset of the sum of a four that an output takes */
};

struct transform {
    size_t order, inner; /* inner: product of the dense orders */
    float scale;
    size_t count;
    struct dense dense[TRANSFORM_MOST_FACTORS];
    void (*multiply)(const struct transform *, const float *, float *, size_t);
};

#define UNROLL _Pragma("GCC unroll 16")
#define NO_UNROLL _Pragma("GCC unroll 1")
typedef float quad __attribute__((vector_size(16)));
#if defined(__clang__)
#define MERGE(x, y, ...) __builtin_shufflevector(x, y, __VA_ARGS__)
#define SHUFFLE4(x, ...) __builtin_shufflevector(x, x, __VA_ARGS__)
#define SHUFFLE8(x, ...) __builtin_shufflevector(x, x, __VA_ARGS__)
#else
typedef int32_t places4 __attribute__((vector_size(16)));
typedef int32_t places8 __attribute__((vector_size(32)));
#define MERGE(x, y, ...) __builtin_shuffle(x, y, (places4){__VA_ARGS__})
#define SHUFFLE4(x, ...) __builtin_shuffle(x, (places4){__VA_ARGS__})
#define SHUFFLE8(x, ...) __builtin_shuffle(x, (places8){__VA_ARGS__})
#endif

/* The transpose of 4 by 4 values, scaled. Steps: from one row to the next. */
static void transpose(const float *from, size_t from_step, float *to, size_t to_step, float scale)
{
    quad rows[4];

    UNROLL
    for (size_t i = 0; i < 4; i++)
        memcpy(&rows[i], from + i * from_step, sizeof *rows);
    quad ab = MERGE(rows[0], rows[1], 0, 4, 1, 5), AB = MERGE(rows[0], rows[1], 2, 6, 3, 7);
    quad cd = MERGE(rows[2], rows[3], 0, 4, 1, 5), CD = MERGE(rows[2], rows[3], 2, 6, 3, 7);
    const quad columns[4] = {MERGE(ab, cd, 0, 1, 4, 5) * scale, MERGE(ab, cd, 2, 3, 6, 7) * scale,
                             MERGE(AB, CD, 0, 1, 4, 5) * scale, MERGE(AB, CD, 2, 3, 6, 7) * scale};
    UNROLL
    for (size_t i = 0; i < 4; i++)
        memcpy(to + i * to_step, &columns[i], sizeof *columns);
}

/* Copies four neighbouring columns, which begin at `from`, scaled, to `column` and the next ones. */
static void gather_four(float (*inputs)[COLUMNS], size_t column, const float *from,
                        const struct dense *dense, float scale)
{
    size_t order = dense->order, stride = dense->stride;

    if (stride == 1) {
        for (size_t i = 0; i < order; i += 4)
            transpose(from + i, order, inputs[i] + column, COLUMNS, scale);
        return;
    }
    for (size_t i = 0; i < order; i++, from += stride)
        for (size_t j = 0; j < 4; j++)
            inputs[i][column + j] = from[j] * scale;
}

/* Copies up to COLUMNS columns from the place of the first on, scaled, so that they lie side by side;
 * the others are left 0. Columns are those of the inputs of a dense factor: at stride 1 each is
 * contiguous, at others, which are multiples of 4, four neighbours are. */
static void gather(float (*inputs)[COLUMNS], const float *from, const struct dense *dense,
                   size_t first, size_t number, float scale)
{
    size_t order = dense->order, stride = dense->stride, column = 0;

    if (number < COLUMNS)
        memset(inputs, 0, order * sizeof *inputs);
    if (number == COLUMNS && first % stride + COLUMNS <= stride) {
        from += first / stride * stride * order + first % stride;
        for (size_t i = 0; i < order; i++, from += stride)
            for (size_t j = 0; j < COLUMNS; j++)
                inputs[i][j] = from[j] * scale;
        return;
    }
    for (; column + 4 <= number; column += 4) {
        size_t place = first + column;
        gather_four(inputs, column, from + place / stride * stride * order + place % stride, dense, scale);
    }
    for (; column < number; column++)
        for (size_t i = 0; i < order; i++)
            inputs[i][column] = from[(first + column) * order + i] * scale;
}

/* The inverse. */
static void scatter(float (*outputs)[COLUMNS], float *to, const struct dense *dense, size_t first, size_t number)
{
    size_t order = dense->order, stride = dense->stride, column = 0;

    if (number == COLUMNS && first % stride + COLUMNS <= stride) {
        to += first / stride * stride * order + first % stride;
        for (size_t i = 0; i < order; i++, to += stride)
            memcpy(to, outputs[i], sizeof *outputs);
        return;
    }
    for (; column + 4 <= number; column += 4) {
        size_t place = first + column;
        float *four = to + place / stride * stride * order + place % stride;
        if (stride == 1) {
            for (size_t i = 0; i < order; i += 4)
                transpose(outputs[i] + column, COLUMNS, four + i, order, 1.0f);
        } else {
            for (size_t i = 0; i < order; i++, four += stride)
                memcpy(four, outputs[i] + column, 4 * sizeof(float));
        }
    }
    for (; column < number; column++)
        for (size_t i = 0; i < order; i++)
            to[(first + column) * order + i] = outputs[i][column];
}

#define LANES 1
#define NAMED(name) name##_1
#define TARGET
#define NARROW_PASS pass_of_1
#include "transform_lanes.h"

#define LANES 4 /* registers of SSE2 or NEON, or else scalars again */
#define NAMED(name) name##_4
#define TARGET
#define NARROW_PASS pass_of_4 /* strides are multiples of 4 */
#include "transform_lanes.h"

#if defined(__x86_64__) || defined(__i386__)
#include <immintrin.h>
#define HAS_AVX2
#define LANES 8
#define NAMED(name) name##_8
#define TARGET __attribute__((target("avx2,fma")))
/* In one operation, which rounds as two do where a factor is ±1. */
#define FUSED8(x, y, z) ((lanes)_mm256_fmadd_ps((__m256)(x), (__m256)(y), (__m256)(z)))
#define NARROW_PASS pass_of_4
#include "transform_lanes.h"
#endif

unsigned transform_lanes(void)
{
#if defined(HAS_AVX2)
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") ? 8 : 4;
#else
    return 4;
#endif
}

/* The sums that the outputs of a dense factor take: bit b is set where input b of a four is negative. */
static uint8_t *taken_sums(size_t order, const int8_t *matrix)
{
    uint8_t *sums = malloc(order / 4 * order);

    for (size_t group = 0; sums && group < order / 4; group++)
        for (size_t j = 0; j < order; j++) {
            const int8_t *signs = matrix + j * order + 4 * group;
            unsigned negative = 0;
            for (unsigned bit = 0; bit < 4; bit++)
                negative |= (unsigned)(signs[bit] < 0) << bit;
            sums[group * order + j] = (uint8_t)(negative * COLUMNS);
        }
    return sums;
}

/* Chooses the way to multiply; lanes: 0 for the most. */
static bool choose(struct transform *transform, unsigned lanes)
{
    static const struct {
        unsigned lanes;
        void (*sylvester)(const struct transform *, const float *, float *, size_t);
        void (*product)(const struct transform *, const float *, float *, size_t);
    } ways[] = {
#if defined(HAS_AVX2)
        {8, multiply_sylvester_8, multiply_product_8},
#endif
        {4, multiply_sylvester_4, multiply_product_4},
        {1, multiply_sylvester_1, multiply_product_1},
    };
    bool sylvester = transform->inner == 1;
    size_t most = sylvester ? transform->order : transform_lanes();

    for (size_t i = 0; i < sizeof ways / sizeof *ways; i++) {
        bool is_able = ways[i].lanes <= transform_lanes() && ways[i].lanes <= most;
        if (is_able && (lanes == 0 || lanes == ways[i].lanes)) {
            transform->multiply = sylvester ? ways[i].sylvester : ways[i].product;
            return true;
        }
    }
    return false;
}

struct transform *transform_new(unsigned twos, size_t count, const size_t *orders,
                                const int8_t *const *matrices, float scale, unsigned lanes)
{
    struct transform *transform = calloc(1, sizeof *transform);

    if (!transform || count > TRANSFORM_MOST_FACTORS || twos > 16)
        goto fail;
    transform->scale = scale;
    transform->inner = 1;
    for (transform->count = count; count-- > 0;) {
        size_t order = orders[count];
        if (order < 4 || order % 4 || order > TRANSFORM_MOST_DENSE || transform->inner * order > TRANSFORM_MOST_ORDER)
            goto fail;
        uint8_t *sums = taken_sums(order, matrices[count]);
        transform->dense[count] = (struct dense){order, transform->inner, sums};
        if (!sums)
            goto fail;
        transform->inner *= order;
    }
    transform->order = transform->inner << twos;
    if (transform->order > TRANSFORM_MOST_ORDER || !choose(transform, lanes))
        goto fail;
    return transform;
fail:
    transform_free(transform);
    return NULL;
}

void transform_free(struct transform *transform)
{
    for (size_t i = 0; transform && i < TRANSFORM_MOST_FACTORS; i++)
        free(transform->dense[i].sums);
    free(transform);
}

size_t transform_order(const struct transform *transform)
{
    return transform->order;
}

void transform_multiply(const struct transform *transform, const float *from, float *to, size_t count)
{
    transform->multiply(transform, from, to, count);
}
