// SPDX-License-Identifier: Apache-2.0

/* What the nodes of a skin send. */
#ifndef TACTILE_CODE_H
#define TACTILE_CODE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "transform.h"

/* A pair of rows that a delay makes alike: row `sent` of a node, read `shift` chips later in its bit, has a
 * correlation of `share` with row `alike` of another one, or with itself inverted; `wrap` is that of the neighbouring bit's chips. */
struct code_twin {
    int32_t sent, alike, shift;
    float share, wrap;
};

struct sparse_code;

/* A frame has `bits` bits of `order` chips, k and N in the comments. Arrays are kept by whoever uses this. */
struct code {
    size_t bits, order, nodes, first; /* first: row of the first node */
    size_t span;                      /* chips of a frame with the pauses between its restarts */
    size_t spare, spare_count;        /* rows of no node that hold no level */
    bool unipolar, scrambled, parity;
    float swing;        /* V, amplitude of a node's row; NaN: unknown */
    float active_share; /* of the amplitude expected of a node, above which its word counts */
    const struct transform *correlate, *spread;
    const float *flips;       /* (k, N) ±1 of scrambled chips, or NULL */
    const int32_t *places;    /* (k·N) of the chips within the span, rising */
    const int32_t *sign_mask; /* (n) to exchange with a word whose row has another sign */
    const struct code_twin *twins;
    size_t twin_count;
    const struct sparse_code *sparse; /* NULL: codes are orthogonal; else there are neither transforms nor twins */
};

#endif
