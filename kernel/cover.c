// SPDX-License-Identifier: Apache-2.0

#include "cover.h"

#include <math.h>
#include <stdbool.h>

#include "vectors.h"

#define MISSED 1e30 /* m, where lines enter what they miss; 0 times that is 0, unlike infinity */
#define LANES 4     /* of doubles4 */
#define QUADS(points) (((points) + LANES - 1) / LANES)
#define KEPT(where, values) ((doubles4)((where) & (mask4)(values))) /* else 0 */
typedef __typeof__((doubles4){0} < 0) mask4;

/* Lines along the normal of a taxel through its points, in the axes of an object: places, way; and where they enter
 * and leave what they were cut with last. */
struct lines {
    size_t points;
    double centre[3], corner, way[3], places[3][COVER_POINTS];
    double enters[COVER_POINTS], leaves[COVER_POINTS];
};

INLINE double greater(double a, double b)
{
    return a > b ? a : b;
}

INLINE double lesser(double a, double b)
{
    return a < b ? a : b;
}

/* Cuts lines with the space between planes at ±size on one axis. */
INLINE void cut_slab(struct lines *lines, const double *places, double way, double size, double parallel)
{
    if (fabs(way) < parallel) {
        size *= 1 + 1e-6; /* lines within a face are inside */
        for (size_t i = 0; i < lines->points; i++)
            lines->enters[i] = fabs(places[i]) > size ? MISSED : lines->enters[i];
        return;
    }
    double slope = 1 / way, reach = size * fabs(slope);
    for (size_t i = 0; i < lines->points; i++) {
        double nearest = -places[i] * slope;
        lines->enters[i] = greater(lines->enters[i], nearest - reach);
        lines->leaves[i] = lesser(lines->leaves[i], nearest + reach);
    }
}

/* A bound that is round: lines are inside where a·s² + 2·b·s + c ≤ 0, with b = v·place. along: they are parallel to
 * the axis of a cylinder. */
struct round {
    const double *weights;
    double size, middle, a, v[3];
    bool along;
};

/* Tells whether any line may be inside: whether the one through the taxel's centre is inside of a greater bound. */
INLINE bool may_cut(const struct lines *lines, struct round *round, double parallel)
{
    double most = 0, b = 0, c = 0, reach;

    round->a = 0;
    for (unsigned k = 0; k < 3; k++) {
        double w = round->weights[k], x = lines->centre[k] - (k == 2 ? round->middle : 0);
        round->v[k] = w * w * lines->way[k];
        round->a += round->v[k] * lines->way[k];
        b += round->v[k] * x;
        c += w * w * x * x;
        most = greater(most, w);
    }
    round->along = round->a < parallel * parallel;
    reach = round->size + most * lines->corner;
    return round->along ? c <= reach * reach : round->a * (c - reach * reach) <= b * b;
}

/* Cuts lines with an ellipsoid, or an endless cylinder. */
INLINE void cut_round(struct lines *lines, const struct round *round)
{
    const double *w = round->weights, *v = round->v, size2 = round->size * round->size;
    double a = round->along ? 1 : round->a, scale = round->along ? MISSED : 1 / a;

    for (size_t i = 0; i < lines->points; i++) {
        double x = lines->places[0][i], y = lines->places[1][i], z = lines->places[2][i] - round->middle;
        double wx = w[0] * x, wy = w[1] * y, wz = w[2] * z, b = v[0] * x + v[1] * y + v[2] * z;
        double square = b * b - a * (wx * wx + wy * wy + wz * wz - size2);
        double half = sqrt(greater(square, 0)) * scale, nearest = -b / a;
        double enters = greater(lines->enters[i], nearest - half);
        lines->leaves[i] = lesser(lines->leaves[i], nearest + half);
        lines->enters[i] = square < 0 ? MISSED : enters;
    }
}

/* Cuts lines with all bounds of a part, from one to before another; returns whether any may be inside. */
INLINE bool cut_part(const struct cover_object *object, struct lines *lines, size_t bound, size_t end)
{
    for (size_t i = 0; i < lines->points; i++) {
        lines->enters[i] = -MISSED;
        lines->leaves[i] = MISSED;
    }
    for (; bound < end; bound++) {
        const double *weights = object->weights + 3 * bound, *size = object->sizes + bound;
        unsigned axis = weights[0] != 0 ? 0 : weights[1] != 0 ? 1 : 2;
        if ((weights[0] != 0) + (weights[1] != 0) + (weights[2] != 0) == 1) {
            cut_slab(lines, lines->places[axis], lines->way[axis], *size / weights[axis], object->parallel);
            continue;
        }
        struct round round = {.weights = weights, .size = *size, .middle = object->middles[bound]};
        if (!may_cut(lines, &round, object->parallel))
            return false;
        cut_round(lines, &round);
    }
    return true;
}

/* Draws the lines of a taxel in an object's axes; returns whether it may be in reach. */
INLINE bool draw(struct lines *lines, const struct cover_skin *skin, size_t taxel, double reach, const double *place,
                 const double *axes)
{
    const double *normal = skin->normals + 3 * taxel, *x = skin->offsets_m + 3 * taxel * skin->points;
    const double *y = x + skin->points, *z = y + skin->points;
    double from[3], height = 0, beside = 0;

    lines->points = skin->points;
    lines->corner = skin->corners_m[taxel];
    reach += lines->corner;
    for (unsigned k = 0; k < 3; k++) {
        from[k] = skin->centres_m[3 * taxel + k] - place[k];
        height += from[k] * normal[k];
    }
    for (unsigned k = 0; k < 3; k++)
        beside += (from[k] - height * normal[k]) * (from[k] - height * normal[k]);
    if (beside > reach * reach)
        return false;
    for (unsigned k = 0; k < 3; k++, axes += 3) {
        lines->centre[k] = axes[0] * from[0] + axes[1] * from[1] + axes[2] * from[2];
        lines->way[k] = axes[0] * normal[0] + axes[1] * normal[1] + axes[2] * normal[2];
        for (size_t i = 0; i < lines->points; i++)
            lines->places[k][i] = lines->centre[k] + axes[0] * x[i] + axes[1] * y[i] + axes[2] * z[i];
    }
    return true;
}

/* Finds where lines enter an object, or MISSED; also where it `stays` and is wholly behind the skin. Returns whether
 * any may meet it. */
INLINE bool cross(const struct cover_object *object, struct lines *lines, bool stays, double *meets)
{
    double leaves[COVER_POINTS];
    bool is_near = false;

    for (size_t i = 0; i < lines->points; i++) {
        meets[i] = MISSED;
        leaves[i] = -MISSED;
    }
    for (size_t part = 0, bound = 0; part < object->parts; bound = (size_t)object->ends[part++]) {
        if (!cut_part(object, lines, bound, (size_t)object->ends[part]))
            continue;
        is_near = true;
        for (size_t i = 0; i < lines->points; i++) {
            bool is_met = lines->enters[i] <= lines->leaves[i];
            meets[i] = lesser(meets[i], is_met ? lines->enters[i] : MISSED);
            leaves[i] = greater(leaves[i], is_met ? lines->leaves[i] : -MISSED);
        }
    }
    for (size_t i = 0; stays && i < lines->points; i++)
        meets[i] = leaves[i] > 0 ? meets[i] : MISSED;
    return is_near;
}

/* Sums over the points that are met before `shift`: area, and area times how far before `from` they are met. */
INLINE void sum_wet(const struct cover_skin *skin, const double *meets, const double *is_near, double shift, double from,
                    double *area, double *volume)
{
    doubles4 areas = {0}, volumes = {0};
    size_t quads = QUADS(skin->points);

    for (size_t taxel = 0; taxel < skin->taxels; taxel++) {
        const doubles4 *met = (const doubles4 *)meets + taxel * quads;
        for (size_t i = 0; is_near[taxel] != 0 && i < quads; i++) {
            doubles4 wet = KEPT(met[i] < shift, (doubles4){0} + skin->point_m2[taxel]);
            areas += wet;
            volumes += wet * (from - met[i]);
        }
    }
    *area = areas[0] + areas[1] + areas[2] + areas[3];
    *volume = volumes[0] + volumes[1] + volumes[2] + volumes[3];
}

/* Returns how far an object has to move to displace this volume; -MISSED if it meets nothing.
 *
 * The volume is Σ a·max(s − e, 0), convex in s. From where all points are wet Newton's steps come from above, and the
 * step is exact that is made on the straight piece on which the depth is. */
INLINE double shift_of(const struct cover_skin *skin, const double *meets, const double *is_near, double volume)
{
    double area, pressed, before;

    sum_wet(skin, meets, is_near, MISSED, 0, &area, &pressed);
    if (area == 0 || volume == 0)
        return -MISSED;
    double shift = (volume - pressed) / area;
    do {
        before = area;
        sum_wet(skin, meets, is_near, shift, shift, &area, &pressed);
        shift += area == 0 ? 0 : (volume - pressed) / area;
    } while (area < before);
    return shift;
}

/* Returns the mean pressure on a taxel whose points are met there, of an object that moves by `shift`. */
INLINE double mean_pa(const doubles4 *met, size_t points, double shift, double stiffness)
{
    doubles4 depths = {0};

    for (size_t i = 0; i < QUADS(points); i++)
        depths += KEPT(met[i] < shift, shift - met[i]);
    return (depths[0] + depths[1] + depths[2] + depths[3]) * stiffness / (double)points;
}

VECTORS void cover_press(const struct cover_skin *skin, const struct cover_object *object, size_t envs,
                         const double *places_m, const double *axes, const double *forces_n, double *meets_m,
                         double *pressures_pa)
{
    size_t stride = QUADS(skin->points) * LANES;
    struct lines lines;

    for (size_t i = 0; i < skin->taxels * stride; i++)
        meets_m[i] = MISSED; /* what fills up quads stays so */
    for (size_t env = 0; env < envs; env++, places_m += 3, axes += 9, pressures_pa += skin->taxels) {
        double force = forces_n ? forces_n[env] : 0, doubt = force < 0 ? NAN : 0 * force, shift = 0;
        for (unsigned k = 0; k < 9; k++)
            doubt += 0 * (places_m[k % 3] + axes[k]);
        for (size_t taxel = 0; taxel < skin->taxels; taxel++) /* 1 where it is near, for now */
            pressures_pa[taxel] = draw(&lines, skin, taxel, object->reach_m, places_m, axes) &&
                                  cross(object, &lines, !forces_n, meets_m + taxel * stride);
        if (forces_n)
            shift = shift_of(skin, meets_m, pressures_pa, force / object->stiffness_pa_per_m);
        for (size_t taxel = 0; taxel < skin->taxels; taxel++) {
            const doubles4 *met = (const doubles4 *)(meets_m + taxel * stride);
            if (pressures_pa[taxel] != 0)
                pressures_pa[taxel] = mean_pa(met, skin->points, shift, object->stiffness_pa_per_m);
            pressures_pa[taxel] += doubt;
        }
    }
}
