// SPDX-License-Identifier: Apache-2.0

/* Words of a frame → pressures, in one call; and what these words say of their nodes.
 *
 * In C, since in numpy these are some fifty passes over all nodes. Of 16 nodes each of them costs a microsecond hot
 * and several after the pause of a frame; of 4096 they read memory again and again. readings/ says what every number
 * means. Flags are bytes, 0 or 1; arrays are (n,) of a skin's nodes unless it is said. */
#ifndef TACTILE_READOUT_H
#define TACTILE_READOUT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "words.h"

/* Bits of a taxel's status; see Status in readings/status.py. */
struct readout_bits {
    uint8_t silent, low_snr, stale, saturated, uncalibrated, masked, faulty;
};

/* How a skin is read. low_rho, low_margin: ρ above which a word is uneven not by noise, and the margin below which it
 * is; see words/health.py. weak: V, of a word that is too faint to count as spoken; NaN: unknown. weak_rho: ρ above
 * which it is no noise. */
struct readout_settings {
    struct readout_bits bits;
    size_t nodes, codes, pieces, taxels;
    float low_rho, low_margin, weak, weak_rho;
};

/* What is known of a skin beside its words, and what is kept of them. */
struct readout_skin {
    const float *table_v; /* (codes,) */
    const uint8_t *state; /* status by health */
    const uint8_t *invalid, *uncalibrated, *masked;
    const float *sign, *rest_v, *margin_v, *end_v; /* V; see Bounds in readings/pressure.py */
    const float *pieces;         /* (p, 3, n) begin, V, gain, Pa/V, width, Pa, of the curves */
    const int32_t *source;       /* (t,) node of every taxel, -1 for none; NULL: taxels are nodes */
    int32_t *kept_codes;         /* the last word, what was uncertain about it, when it came, s */
    uint8_t *kept_flags;
    double *heard_s;
    float *sums; /* (6, n) fading: words, amplitudes, uneven, doubled, odd, faint ones */
};

/* A frame's readings, (t,). For tare and drift: V, Pa before the tare, and whether it counts. */
struct readout_frame {
    float *pressure_pa, *voltage_v;
    uint8_t *status;
    float *node_v, *node_pa;
    uint8_t *valid;
};

struct readout;

/* NULL: out of memory, or settings and arrays do not fit each other. The arrays of the skin have to outlive it. */
struct readout *readout_new(const struct readout_settings *settings, const struct readout_skin *skin);
void readout_free(struct readout *readout);

/* Converts the words of a frame to readings. counts: the words say something of their nodes. drift_v, tare_pa: added
 * to voltages, taken off pressures. */
void readout_read(struct readout *readout, const struct words *words, bool counts, double now_s, double stale_after_s,
                  const float *drift_v, const float *tare_pa, const struct readout_frame *frame);

#endif
