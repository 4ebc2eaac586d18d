// SPDX-License-Identifier: Apache-2.0

/* Pressures → contacts: what NumpyGatherer in tactile_cdma/readings/gather.py does for all taxels of a
 * frame. Flags are bytes, 0 or 1. */
#ifndef TACTILE_CONTACTS_H
#define TACTILE_CONTACTS_H

#include <stddef.h>
#include <stdint.h>

#define CONTACTS_MOMENTS 10 /* per taxel: load, load·position, force, torque, per pascal */
#define CONTACTS_SUMS 11    /* the moments, and the area */

/* neighbours: (taxels, near), symmetric, padded with each taxel's own index. moments: (taxels,
 * CONTACTS_MOMENTS). */
struct contacts_skin {
    size_t taxels, near;
    const int32_t *neighbours;
    const double *moments;
};

/* Thresholds, Pa; the bit of a taxel's status that says it is beyond its range. */
struct contacts_limits {
    float contact_pa, release_pa, rim_pa;
    uint8_t saturated;
};

/* From frame to frame, (taxels,): index of the contact, -1 for none; whether there is a reading. */
struct contacts_kept {
    int32_t *place;
    uint8_t *unread;
};

struct contacts_load {
    double load_n;
    int32_t label;
};

/* All (taxels,). */
struct contacts_scratch {
    int32_t *root, *label, *rank;
    struct contacts_load *loads;
};

/* taxels, before: (taxels,) those in contact, contact by contact, and their contacts in the frame before.
 * starts: (taxels + 1,) where each contact begins among these, and where the last ends. Of each contact:
 * sums, (taxels, CONTACTS_SUMS), and (taxels,) greatest pressure, whether a taxel is saturated, whether
 * one in it or beside it may carry more than it reads, whether one there lost or got its reading. */
struct contacts_found {
    int32_t *taxels, *before, *starts;
    double *sums;
    float *peak_pa;
    uint8_t *saturated, *lower_bound, *torn;
};

/* Returns the number of contacts, the strongest first; SIZE_MAX for a neighbour that is no taxel. */
size_t contacts_gather(const struct contacts_skin *skin, const struct contacts_limits *limits,
                       const float *pressure_pa, const uint8_t *status,
                       const struct contacts_kept *kept, const struct contacts_scratch *scratch,
                       const struct contacts_found *found);

#endif
