// SPDX-License-Identifier: Apache-2.0

/* Correlations of a frame → words → pressures, in one call, for a frame in which nothing is odd.
 *
 * In C, since in numpy these are some hundred passes over all nodes. Of 16 nodes each of them costs a
 * microsecond hot and several after the pause of a frame; of 4096 they read memory again and again. What
 * is odd stays in Python: words/decode.py, words/health.py and readings/ say what every number means, and
 * do the same to the bit. Flags are bytes, 0 or 1; arrays are (n,) of a skin's nodes unless it is said. */
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

/* How a skin is read. */
struct readout_settings {
    struct words_frame frame;
    struct words_reading reading;
    struct words_lateness lateness;
    struct readout_bits bits;
    bool scrambled;
    size_t spare, spare_count; /* rows of the code that no node uses */
    size_t codes, pieces, taxels;
};

/* What is known of a skin beside its words, and what is kept of them. */
struct readout_skin {
    const int32_t *sign_mask;
    const float *offset;  /* (k, N), see words_read; NULL where chips are not scrambled */
    float *expected;      /* V, amplitude; written to where that is learnt from every frame */
    const float *edges;   /* (4, N), see words_late */
    const float *table_v; /* (codes,) */
    const uint8_t *state; /* status by health */
    const uint8_t *invalid, *uncalibrated, *masked;
    const float *sign, *rest_v, *margin_v, *end_v; /* V; see Bounds in readings/pressure.py */
    const float *pieces;         /* (p, 3, n) begin, V, gain, Pa/V, width, Pa, of the curves */
    const int32_t *source;       /* (t,) node of every taxel, -1 for none; NULL: taxels are nodes */
    int32_t *kept_codes;         /* the last word, what was uncertain about it, when it came, s */
    uint8_t *kept_flags;
    double *heard_s;
    float *sums; /* (5, n) fading: words, amplitudes, uneven, doubled, odd ones */
};

/* A frame's words and readings; the latter (t,). For tare and drift: V, Pa before the tare, and whether it
 * counts. */
struct readout_frame {
    uint8_t *active, *doubtful, *doubled, *odd;
    int32_t *codes;
    float *amplitude, *rho, *margin;
    float *pressure_pa, *voltage_v;
    uint8_t *status;
    float *node_v, *node_pa;
    uint8_t *valid;
};

struct readout;

/* NULL: out of memory, or settings and arrays do not fit each other. The arrays of the skin have to outlive it. */
struct readout *readout_new(const struct readout_settings *settings, const struct readout_skin *skin);
void readout_free(struct readout *readout);
const struct readout_settings *readout_settings(const struct readout *readout);

enum readout_look {
    READOUT_ODD,  /* a word is: nothing was kept, and nothing is meant by the frame */
    READOUT_LEFT, /* the words leave energy over, and only Python can tell what it is: nothing was kept */
    READOUT_FEW,  /* the same, and it is asked only whether these few words differ in their delays */
    READOUT_DOUBTFUL, /* a word is uncertain, and nothing else is odd */
    READOUT_PLAIN,
};

/* Reads the words of a frame, counts them, and converts them to readings. rows: (k, N) V; with
 * spoke, (k, speakers) of these nodes. per_noise, least_usual: see words_read. in_place: what they leave over is not
 * asked. drift_v, tare_pa: added to voltages, taken off pressures. */
enum readout_look readout_read(struct readout *readout, const float *rows, const int32_t *spoke,
                               size_t speakers, float per_noise,
                               float least_usual, bool in_place, double now_s, double stale_after_s,
                               const float *drift_v, const float *tare_pa,
                               const struct readout_frame *frame);

#endif
