// SPDX-License-Identifier: Apache-2.0

/* The sync line's edges, past and announced, in order. Every node reads them at its own pace. On the data wire they
 * are those of the digitizer's pull-down, and nodes' comparators see voltages. */
#ifndef SYNC_LINE_H
#define SYNC_LINE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct sync_edge {
    int64_t t_ns;
    bool level;
};

struct sync_line {
    struct sync_edge *edges;
    size_t size, capacity;
    uint64_t dropped; /* edges removed before edges[0], because all nodes have seen them */
    double rest_v, low_v; /* the data wire: at rest, pulled low */
    int64_t back_ns;      /* from its release until it is back above the comparators' level */
};

#endif
