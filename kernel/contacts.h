// SPDX-License-Identifier: Apache-2.0

/* Pressures → contacts, of all taxels of a frame; see Gathered in tactile_cdma/readings/contact.py. In C, as numpy
 * lets go of Python's lock in every other step, which in a process of many patches is then another thread's. */
#ifndef TACTILE_CONTACTS_H
#define TACTILE_CONTACTS_H

#include <stddef.h>
#include <stdint.h>

#define CONTACTS_MOMENTS 10 /* per taxel: load, load·position, force, torque, per pascal */
#define CONTACTS_SUMS 11    /* the moments, and the area */
#define CONTACTS_SCRATCH 3
#define CONTACTS_TALLY 4

/* neighbours: (taxels, near), symmetric, padded with each taxel's own index. moments: (taxels,
 * CONTACTS_MOMENTS). Thresholds, Pa; saturated, uncertain, masked: the bits of a taxel's status that say
 * so. The reading of one that is uncertain counts as none. */
struct contacts_skin {
    size_t taxels, near;
    const int32_t *neighbours;
    const double *moments;
    float contact_pa, release_pa, rim_pa;
    uint8_t saturated, uncertain, masked;
};

/* From frame to frame, (taxels,): index of the contact, -1 for none; bits of what is to be said of the
 * reading, 1 before the first frame. scratch: (CONTACTS_SCRATCH, taxels). loads: (taxels,). */
struct contacts_kept {
    int32_t *place;
    uint8_t *notes;
    int32_t *scratch;
    double *loads;
};

/* taxels, before: (taxels,) those in contact, contact by contact, and their contacts in the frame before.
 * starts: (taxels + 1,) where each contact begins among these, and where the last ends. Of each contact:
 * sums, (taxels, CONTACTS_SUMS), and (taxels,) greatest pressure, and, 0 or 1, whether a taxel is
 * saturated, whether one in it or beside it may carry more than it reads, whether one there lost or got
 * its reading. tally: (CONTACTS_TALLY,) taxels of the skin that are valid, in service, doubtful (see
 * Coverage in tactile_cdma/readings/taxels.py), and those in contact that were not in that contact before. */
struct contacts_found {
    int32_t *taxels, *before, *starts, *tally;
    double *sums;
    float *peak_pa;
    uint8_t *saturated, *lower_bound, *torn;
};

/* Returns the number of contacts, the strongest first; SIZE_MAX for a neighbour that is no taxel. */
size_t contacts_gather(const struct contacts_skin *skin, const float *pressure_pa, const uint8_t *status,
                       const struct contacts_kept *kept, const struct contacts_found *found);

#endif
