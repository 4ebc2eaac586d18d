// SPDX-License-Identifier: Apache-2.0

/* Counts the samples in successive intervals of time, exactly and without division.
 *
 * Times are in thousandths of a tick of the sampling clock, in which every time of the protocol is an
 * integer. Each step gives the number of samples in an interval and the phase: the time from the
 * interval's end to the next sample.
 */
#ifndef TACTILE_STRIDE_H
#define TACTILE_STRIDE_H

#include <stdbool.h>
#include <stdint.h>

#define STRIDE_MILLI 1000u /* thousandths in a tick */

struct stride {
    uint64_t samples; /* whole sample periods in the interval … */
    uint32_t rest;    /* … and the remainder */
    uint32_t sample;  /* sample period */
};

static inline struct stride stride_of(uint64_t length, uint32_t sample)
{
    struct stride stride = {length / sample, (uint32_t)(length % sample), sample};

    return stride;
}

/* Returns the number of samples in the interval. phase: time from its beginning to its first sample,
 * less than a sample period; becomes that of the next interval. */
static inline uint64_t stride_walk(const struct stride *stride, uint32_t *phase)
{
    bool one_more = *phase < stride->rest;

    *phase -= stride->rest;
    if (one_more)
        *phase += stride->sample;
    return stride->samples + one_more;
}

#endif
