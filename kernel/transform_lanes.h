// SPDX-License-Identifier: Apache-2.0

/* The transform for vector registers of LANES floats. Included by transform.c once for each number of
 * lanes, with these defined:
 *
 *     LANES         1, 4 or 8
 *     NAMED(name)   name with the number of lanes
 *     TARGET        attribute of functions that use these registers
 *     NARROW_PASS   pass_of for strides that are no multiple of LANES
 */

#define lanes NAMED(lanes)
#if LANES == 1
typedef float lanes;
#else
typedef float lanes __attribute__((vector_size(LANES * sizeof(float)), may_alias));
#endif

TARGET INLINE lanes NAMED(load)(const float *from)
{
    lanes x;

    memcpy(&x, from, sizeof x);
    return x;
}

TARGET INLINE void NAMED(store)(float *to, lanes x)
{
    memcpy(to, &x, sizeof x);
}

/* Butterflies of `radix` values each, among values that follow each other at a stride. */
TARGET INLINE void NAMED(butterflies)(lanes *x, unsigned radix)
{
    UNROLL
    for (unsigned half = radix / 2; half; half /= 2) {
        UNROLL
        for (unsigned i = 0; i < radix; i++) {
            if (!(i & half)) {
                lanes a = x[i], b = x[i | half];
                x[i] = a + b;
                x[i | half] = a - b;
            }
        }
    }
}

TARGET INLINE void NAMED(pass)(const float *from, float *to, size_t stride, unsigned radix, float scale)
{
    for (size_t place = 0; place < stride; place += LANES) {
        lanes x[8];
        UNROLL
        for (unsigned i = 0; i < radix; i++)
            x[i] = NAMED(load)(from + place + i * stride) * scale;
        NAMED(butterflies)(x, radix);
        UNROLL
        for (unsigned i = 0; i < radix; i++)
            NAMED(store)(to + place + i * stride, x[i]);
    }
}

TARGET static void NAMED(pass_of)(const float *from, float *to, size_t stride, unsigned radix, float scale)
{
    if (scale != 1.0f) { /* once in a transform */
        if (radix == 8)
            NAMED(pass)(from, to, stride, 8, scale);
        else if (radix == 4)
            NAMED(pass)(from, to, stride, 4, scale);
        else
            NAMED(pass)(from, to, stride, 2, scale);
    } else if (radix == 8) {
        NAMED(pass)(from, to, stride, 8, 1.0f);
    } else if (radix == 4) {
        NAMED(pass)(from, to, stride, 4, 1.0f);
    } else {
        NAMED(pass)(from, to, stride, 2, 1.0f);
    }
}

/* Butterflies within a register. */
TARGET INLINE lanes NAMED(inside)(lanes x)
{
#if LANES == 8
    x = FUSED8(x, ((lanes){1, 1, 1, 1, -1, -1, -1, -1}), SHUFFLE8(x, 4, 5, 6, 7, 0, 1, 2, 3));
    x = FUSED8(x, ((lanes){1, 1, -1, -1, 1, 1, -1, -1}), SHUFFLE8(x, 2, 3, 0, 1, 6, 7, 4, 5));
    x = FUSED8(x, ((lanes){1, -1, 1, -1, 1, -1, 1, -1}), SHUFFLE8(x, 1, 0, 3, 2, 5, 4, 7, 6));
#elif LANES == 4
    x = SHUFFLE4(x, 2, 3, 0, 1) + x * (lanes){1, 1, -1, -1};
    x = SHUFFLE4(x, 1, 0, 3, 2) + x * (lanes){1, -1, 1, -1};
#endif
    return x;
}

/* Sylvester's matrix of order radix · LANES, times vectors on end. */
TARGET INLINE void NAMED(leaves)(const float *from, float *to, size_t end, unsigned radix, float scale)
{
    for (size_t at = 0; at < end; at += radix * LANES) {
        lanes x[8];
        UNROLL
        for (unsigned i = 0; i < radix; i++)
            x[i] = NAMED(load)(from + at + i * LANES) * scale;
        NAMED(butterflies)(x, radix);
        UNROLL
        for (unsigned i = 0; i < radix; i++)
            NAMED(store)(to + at + i * LANES, NAMED(inside)(x[i]));
    }
}

/* Radix of the first pass over this many butterfly stages, if no pass has more than three. */
#define FIRST_RADIX(stages) (1u << ((stages) % 3 ? (stages) % 3 : 3))

/* Sylvester's matrix of order LANES to LANES · 8 · 2^stages times `count` vectors. */
TARGET static void NAMED(sylvester)(const float *from, float *to, size_t order, size_t count,
                                    unsigned stages, float scale)
{
    if (stages) {
        unsigned radix = FIRST_RADIX(stages);
        for (; count; count--, from += order, to += order) {
            NAMED(pass_of)(from, to, order / radix, radix, scale);
            NAMED(sylvester)(to, to, order / radix, radix, stages - (stages - 1) % 3 - 1, 1.0f);
        }
        return;
    }
    if (order == 8 * LANES)
        NAMED(leaves)(from, to, order * count, 8, scale);
    else if (order == 4 * LANES)
        NAMED(leaves)(from, to, order * count, 4, scale);
    else if (order == 2 * LANES)
        NAMED(leaves)(from, to, order * count, 2, scale);
    else
        NAMED(leaves)(from, to, order * count, 1, scale);
}

TARGET static void NAMED(multiply_sylvester)(const struct transform *transform, const float *from,
                                             float *to, size_t count)
{
    unsigned stages = 0;

    while (transform->order >> stages > 8 * LANES)
        stages++;
    NAMED(sylvester)(from, to, transform->order, count, stages, transform->scale);
}

/* The 16 sums of each four of inputs, of `width` columns, in the order of `sums` in transform.c. */
TARGET INLINE void NAMED(add_up)(float (*inputs)[COLUMNS], float (*sums)[16][COLUMNS], size_t groups, unsigned width)
{
    for (size_t group = 0; group < groups; group++, inputs += 4) {
        UNROLL
        for (unsigned column = 0; column < width; column += LANES) {
            lanes a = NAMED(load)(inputs[0] + column), b = NAMED(load)(inputs[1] + column);
            lanes c = NAMED(load)(inputs[2] + column), d = NAMED(load)(inputs[3] + column);
            lanes left[4] = {a + b, b - a, a - b, -a - b};
            lanes right[4] = {c + d, d - c, c - d, -c - d};
            UNROLL
            for (unsigned i = 0; i < 16; i++)
                NAMED(store)(sums[group][i] + column, left[i % 4] + right[i / 4]);
        }
    }
}

/* Four outputs as they are, or 0 before the first sums. */
TARGET INLINE void NAMED(sums_so_far)(lanes (*x)[COLUMNS / LANES], float (*outputs)[COLUMNS], bool none, unsigned width)
{
    UNROLL
    for (unsigned i = 0; i < 4; i++) {
        UNROLL
        for (unsigned v = 0; v < width / LANES; v++)
            x[i][v] = none ? (lanes){0} : NAMED(load)(outputs[i] + v * LANES);
    }
}

/* One dense factor times `width` columns. */
TARGET INLINE void NAMED(dense_columns)(const struct dense *dense, float (*inputs)[COLUMNS],
                                        float (*outputs)[COLUMNS], unsigned width)
{
    float sums[GROUPS][16][COLUMNS];
    size_t order = dense->order, left = order / 4;

    for (size_t first = 0; first < left; first += GROUPS) {
        size_t groups = left - first < GROUPS ? left - first : GROUPS;
        NAMED(add_up)(inputs + 4 * first, sums, groups, width);
        for (size_t j = 0; j < order; j += 4) {
            const uint8_t *taken = dense->sums + first * order + j;
            lanes x[4][COLUMNS / LANES];
            NAMED(sums_so_far)(x, outputs + j, first == 0, width);
            NO_UNROLL
            for (size_t group = 0; group < groups; group++, taken += order) {
                UNROLL
                for (unsigned i = 0; i < 4; i++) {
                    const float *sum = (const float *)sums[group] + taken[i];
                    UNROLL
                    for (unsigned v = 0; v < width / LANES; v++)
                        x[i][v] += NAMED(load)(sum + v * LANES);
                }
            }
            UNROLL
            for (unsigned i = 0; i < 4; i++) {
                UNROLL
                for (unsigned v = 0; v < width / LANES; v++)
                    NAMED(store)(outputs[j + i] + v * LANES, x[i][v]);
            }
        }
    }
}

/* One dense factor times all columns of `size` values. */
TARGET static void NAMED(multiply_dense)(const struct dense *dense, const float *from, float *to,
                                         size_t size, float scale)
{
    float inputs[TRANSFORM_MOST_DENSE][COLUMNS], outputs[TRANSFORM_MOST_DENSE][COLUMNS];
    size_t order = dense->order, columns = size / order;

    for (size_t first = 0; first < columns; first += COLUMNS) {
        size_t number = columns - first < COLUMNS ? columns - first : COLUMNS;
        gather(inputs, from, dense, first, number, scale);
        if (number > COLUMNS / 2)
            NAMED(dense_columns)(dense, inputs, outputs, COLUMNS);
        else
            NAMED(dense_columns)(dense, inputs, outputs, COLUMNS / 2);
        scatter(outputs, to, dense, first, number);
    }
}

TARGET static void NAMED(multiply_some)(const struct transform *transform, const float *from, float *to, size_t count)
{
    size_t order = transform->order, inner = transform->inner, size = order * count;
    float scale = transform->scale;

    if (order > inner) {
        unsigned stages = 0, radix;
        while (order >> stages > inner)
            stages++;
        for (size_t whole = order; stages; whole /= radix, stages -= (stages - 1) % 3 + 1) {
            radix = FIRST_RADIX(stages);
            size_t stride = whole / radix;
            for (size_t i = 0; i < size; i += whole)
                (stride % LANES ? NARROW_PASS : NAMED(pass_of))(from + i, to + i, stride, radix, scale);
            from = to;
            scale = 1.0f;
        }
    }
    for (size_t i = 0; i < transform->count; i++) {
        NAMED(multiply_dense)(&transform->dense[i], from, to, size, scale);
        from = to;
        scale = 1.0f;
    }
}

/* Multiplies as many vectors at once as stay in the nearest cache. */
TARGET static void NAMED(multiply_product)(const struct transform *transform, const float *from,
                                           float *to, size_t count)
{
    size_t order = transform->order, some = CACHED / order + 1;

    for (; count > some; count -= some, from += some * order, to += some * order)
        NAMED(multiply_some)(transform, from, to, some);
    NAMED(multiply_some)(transform, from, to, count);
}

#undef lanes
#undef FIRST_RADIX
#undef LANES
#undef NAMED
#undef TARGET
#undef NARROW_PASS
