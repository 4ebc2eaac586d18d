// SPDX-License-Identifier: Apache-2.0

/* Sync pulses on the data wire: while the digitizer pulls it low, and until it has settled, samples say nothing
 * of the nodes. From a pulse's edge until the chip that it announces, the last sample before is repeated. */
#ifndef TACTILE_PULL_H
#define TACTILE_PULL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "pulses.h"
#include "stream.h"

struct pull {
    bool on;
    uint32_t unseen; /* frames' pulses since power-up that the wire did not follow */

    const struct pulses *pulses;
    struct pulse_walk walk;
    struct dg_pulse pulse; /* the present one, or the next */
    uint64_t position;     /* of the next sample in the stream */
    uint64_t from, to;     /* samples that repeat the last one before them */
    uint16_t last;
    uint16_t swing;        /* counts that the wire moves at least */
    bool judged;           /* the wire has followed the present pulse, or none of this can be said */
};

/* A stream begins. */
void pull_begin(struct pull *pull, const struct pulses *pulses, const struct dg_board *board);
/* Passes the next samples on. */
void pull_samples(struct pull *pull, struct stream *stream, const uint16_t *counts, size_t size);
/* Takes note that `size` samples are missing, and passes that on. */
void pull_lost(struct pull *pull, struct stream *stream, uint32_t size);

#endif
