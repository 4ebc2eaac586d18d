// SPDX-License-Identifier: Apache-2.0

#include "readings.h"

#include <math.h>

double readings_hear(size_t nodes, const uint8_t *restrict active, const uint8_t *restrict doubtful,
                     const int32_t *restrict codes, const struct readings_kept *kept,
                     const float *restrict table, size_t most_codes, const uint8_t *restrict state,
                     const uint8_t *restrict untrusted, const float *restrict rest_v, double now_s,
                     double stale_after_s, const struct readings_bits *bits,
                     const struct readings_heard *heard)
{
    double oldest_s = INFINITY; /* of the words that are not stale */

    for (size_t i = 0; i < nodes; i++) {
        if (active[i]) {
            kept->codes[i] = codes[i];
            kept->heard_s[i] = now_s;
        }
        if (active[i] | doubtful[i])
            kept->flags[i] = doubtful[i] ? bits->low_snr : 0;
        size_t code = (size_t)kept->codes[i];
        if (code >= most_codes)
            return NAN;
        float volts = table[code];
        bool stale = now_s - kept->heard_s[i] > stale_after_s;
        uint8_t status = kept->flags[i] | state[i] | (active[i] ? 0 : bits->silent);
        heard->voltage_v[i] = volts;
        heard->raised_v[i] = code == most_codes - 1 && volts < rest_v[i] ? rest_v[i] : volts;
        heard->status[i] = stale ? bits->silent | bits->stale : status;
        heard->valid[i] = !stale && !untrusted[i];
        if (!stale && kept->heard_s[i] < oldest_s)
            oldest_s = kept->heard_s[i];
    }
    return oldest_s + stale_after_s;
}

void readings_convert(size_t nodes, const float *restrict volts, const float *restrict drift_v,
                      const float *restrict pieces, size_t count, const float *restrict end_v,
                      float *restrict pressure_pa, uint8_t *restrict saturated)
{
    for (size_t i = 0; i < nodes; i++) {
        pressure_pa[i] = 0;
        saturated[i] = volts[i] + drift_v[i] < end_v[i];
    }
    for (size_t piece = 0; piece < count; piece++, pieces += 3 * nodes) {
        const float *begin_v = pieces, *width_v = pieces + nodes, *gain = pieces + 2 * nodes;
        for (size_t i = 0; i < nodes; i++) {
            float fall_v = begin_v[i] - (volts[i] + drift_v[i]);
            fall_v = fall_v < 0 ? 0 : fall_v;
            fall_v = fall_v > width_v[i] ? width_v[i] : fall_v;
            pressure_pa[i] += fall_v * gain[i];
        }
    }
}

void readings_finish(size_t nodes, const uint8_t *restrict saturated, const uint8_t *restrict valid,
                     const uint8_t *restrict uncalibrated, const uint8_t *restrict masked,
                     const struct readings_bits *bits, uint8_t *restrict status,
                     float *restrict pressure_pa, float *restrict voltage_v)
{
    const struct readings_bits bit = *bits;

    for (size_t i = 0; i < nodes; i++) {
        uint8_t all = status[i] | (saturated[i] & valid[i] ? bit.saturated : 0) |
                      (uncalibrated[i] ? bit.uncalibrated : 0);
        status[i] = masked[i] ? bit.masked : all;
        pressure_pa[i] = valid[i] ? pressure_pa[i] : NAN;
        voltage_v[i] = valid[i] ? voltage_v[i] : NAN;
    }
}

bool readings_count(size_t nodes, const uint8_t *restrict active, const float *restrict amplitude_v,
                    const float *restrict rho, const float *restrict margin,
                    const uint8_t *restrict doubtful, const uint8_t *restrict doubled,
                    const uint8_t *restrict odd, const uint8_t *restrict astray,
                    const struct readings_limits *limits, const struct readings_seen *seen)
{
    const struct readings_limits limit = *limits;
    int32_t most = 0;

    for (size_t i = 0; i < nodes; i++) {
        bool clear = rho[i] > limit.low_rho, weak = margin[i] < limit.low_margin;
        /* Too weak to count as spoken, but too even and too strong to be noise. */
        bool heard = active[i] || (amplitude_v[i] > limit.weak_v && rho[i] > limit.weak_rho &&
                                   margin[i] > limit.low_margin);
        seen->words[i] += (float)heard;
        seen->amplitude_v[i] += amplitude_v[i] * (float)heard;
        seen->uneven[i] += (float)(doubtful[i] && clear && weak);
        seen->doubled[i] += (float)doubled[i];
        seen->odd[i] += (float)(odd[i] && clear && !weak);
        int32_t left = seen->suspected[i] - 1, anew = astray[i] ? limit.suspected_frames : 0;
        left = left < anew ? anew : left;
        seen->suspected[i] = left;
        most = left > most ? left : most;
    }
    return most > 0;
}
