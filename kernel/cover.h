// SPDX-License-Identifier: Apache-2.0

/* Objects → pressures: one object pressed into the elastic covers of many equal skins; see BatchCover in
 * tactile_cdma/sim/batch/cover.py. In C, as libraries of arrays go through memory for each of the operations that a
 * point has. */
#ifndef TACTILE_COVER_H
#define TACTILE_COVER_H

#include <stddef.h>
#include <stdint.h>

#define COVER_POINTS 64 /* of a taxel, at most */

/* centres_m, normals: (taxels, 3). offsets_m: (taxels, 3, points) from the centre; corners_m: (taxels,) the farthest
 * that they may be. point_m2: (taxels,) area of a point. */
struct cover_skin {
    size_t taxels, points;
    const double *centres_m, *normals, *offsets_m, *corners_m, *point_m2;
};

/* The union of parts, each the space within all of its bounds (Bound in tactile_cdma/places/bounds.py): weights,
 * (bounds, 3), sizes and middles, (bounds,). ends: (parts,) number of bounds up to a part's end. reach_m: no line
 * touches the object that passes its origin farther away. parallel: parts of directions below this are 0. */
struct cover_object {
    size_t parts;
    const int32_t *ends;
    const double *weights, *sizes, *middles;
    double reach_m, parallel, stiffness_pa_per_m;
};

/* places_m: (envs, 3). axes: (envs, 3, 3), the object's own in rows. forces_n: (envs,) with which it is pressed along
 * the normals, or null: it stays. meets_m: (taxels·(points + 3),) to work in. pressures_pa: (envs, taxels), NaN where
 * something is, or a force is negative. */
void cover_press(const struct cover_skin *skin, const struct cover_object *object, size_t envs,
                 const double *places_m, const double *axes, const double *forces_n, double *meets_m,
                 double *pressures_pa);

#endif
