// SPDX-License-Identifier: Apache-2.0

/* Words → pressures: what tactile_cdma/readings/stages.py and words/health.py do for all nodes of a frame.
 * Arithmetic is that of numpy in float32, per node in the same order. Flags are bytes, 0 or 1. */
#ifndef TACTILE_READINGS_H
#define TACTILE_READINGS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Bits of a taxel's status; see Status in taxels.py. */
struct readings_bits {
    uint8_t silent, low_snr, stale, saturated, uncalibrated, masked;
};

/* What is kept of every node, (n,): its last word, what was uncertain about it, and when it came, s. */
struct readings_kept {
    int32_t *codes;
    uint8_t *flags;
    double *heard_s;
};

/* What words say, (n,): V; V but at rest at least for the highest code; status; whether it counts. */
struct readings_heard {
    float *voltage_v, *raised_v;
    uint8_t *status, *valid;
};

/* As numpy_hear in stages.py. table: (codes,) V. state: (n,) status by the nodes' health. Returns the
 * time, s, when the next node goes stale, or NaN for a code beyond the table. */
double readings_hear(size_t nodes, const uint8_t *active, const uint8_t *doubtful,
                     const int32_t *codes, const struct readings_kept *kept, const float *table,
                     size_t most_codes, const uint8_t *state, const uint8_t *untrusted,
                     const float *rest_v, double now_s, double stale_after_s,
                     const struct readings_bits *bits, const struct readings_heard *heard);

/* As numpy_convert in stages.py. pieces: (p, 3, n): begin and width, V, and gain, Pa/V, of each piece of
 * the curves. end_v: (n,). */
void readings_convert(size_t nodes, const float *volts, const float *drift_v, const float *pieces,
                      size_t count, const float *end_v, float *pressure_pa, uint8_t *saturated);

/* As numpy_finish in stages.py. */
void readings_finish(size_t nodes, const uint8_t *saturated, const uint8_t *valid,
                     const uint8_t *uncalibrated, const uint8_t *masked,
                     const struct readings_bits *bits, uint8_t *status, float *pressure_pa,
                     float *voltage_v);

/* What was seen of each node's words, (n,): fading sums, and for how many frames it is suspected. */
struct readings_seen {
    float *words, *amplitude_v, *uneven, *doubled, *odd;
    int32_t *suspected;
};

/* Limits of NodeHealth; weak_v: least amplitude of a word that is too weak to count, V, or NaN. */
struct readings_limits {
    float weak_v, weak_rho, low_margin, low_rho;
    int32_t suspected_frames;
};

/* Counts one frame's words, as numpy_count in health.py; returns whether a node is suspected. */
bool readings_count(size_t nodes, const uint8_t *active, const float *amplitude_v, const float *rho,
                    const float *margin, const uint8_t *doubtful, const uint8_t *doubled,
                    const uint8_t *odd, const uint8_t *astray, const struct readings_limits *limits,
                    const struct readings_seen *seen);

#endif
