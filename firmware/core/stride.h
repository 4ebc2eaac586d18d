// SPDX-License-Identifier: Apache-2.0

/* Stretches of time among equally spaced samples, exactly and without division.
 *
 * Times are counted in thousandths of a tick of the sampling clock, in which every time of the
 * protocol is whole. Stretches that follow each other are walked through: of each it is known how
 * many samples are taken in it, and how far behind its end the next sample is, its phase.
 */
#ifndef TACTILE_STRIDE_H
#define TACTILE_STRIDE_H

#include <stdbool.h>
#include <stdint.h>

#define STRIDE_MILLI 1000u /* thousandths in a tick */

struct stride {
    uint64_t samples; /* sample periods in it, whole ones … */
    uint32_t rest;    /* … and what is left over */
    uint32_t sample;  /* a sample period */
};

static inline struct stride stride_of(uint64_t length, uint32_t sample)
{
    struct stride stride = {length / sample, (uint32_t)(length % sample), sample};

    return stride;
}

/* Number of samples in the stretch. phase, from its begin to its first sample, below a sample
 * period, becomes that of the stretch after it. */
static inline uint64_t stride_walk(const struct stride *stride, uint32_t *phase)
{
    bool one_more = *phase < stride->rest;

    *phase -= stride->rest;
    if (one_more)
        *phase += stride->sample;
    return stride->samples + one_more;
}

#endif
