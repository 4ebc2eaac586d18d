// SPDX-License-Identifier: Apache-2.0

#include "readout.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "vectors.h"

#define BLOCK 256 /* nodes that go through all steps together: they stay in the nearest cache */

struct readout {
    struct readout_settings settings;
    struct readout_skin skin;
    float *floats; /* scratch: (4, n), (3, N) */
    int32_t *ints; /* (2, n) */
    uint8_t *late; /* n */
};

struct readout *readout_new(const struct readout_settings *settings, const struct readout_skin *skin)
{
    struct readout *readout = calloc(1, sizeof *readout);
    size_t nodes = settings->frame.nodes, order = settings->frame.order;

    if (!readout)
        return NULL;
    readout->settings = *settings;
    readout->skin = *skin;
    readout->floats = malloc((4 * nodes + 3 * order) * sizeof(float));
    readout->ints = malloc(2 * nodes * sizeof(int32_t));
    readout->late = malloc(nodes);
    if (readout->floats && readout->ints && readout->late)
        return readout;
    readout_free(readout);
    return NULL;
}

void readout_free(struct readout *readout)
{
    free(readout->floats);
    free(readout->ints);
    free(readout->late);
    free(readout);
}

const struct readout_settings *readout_settings(const struct readout *readout)
{
    return &readout->settings;
}

/* ---- words ------------------------------------------------------------------------------------- */

/* Whether the energy that words leave over is a word on another's row, of a node that is late or not
 * known: `displaced` in lateness.py, but for scrambled frames and the few words whose delays it compares,
 * of which Python is asked. */
static enum readout_look find_displaced(struct readout *readout, const float *rows, const struct readout_frame *out)
{
    const struct readout_settings *settings = &readout->settings;
    const struct words_frame *frame = &settings->frame;
    float *meant = readout->floats + 4 * frame->nodes, *spare = meant + frame->order;
    float least = INFINITY;
    size_t spoken = 0;

    memset(meant, 0, frame->order * sizeof *meant);
    for (size_t i = 0; i < frame->nodes; i++)
        if (out->active[i]) {
            spoken++;
            meant[frame->first + i] = out->amplitude[i];
            least = out->amplitude[i] < least ? out->amplitude[i] : least;
        }
    if (settings->scrambled || spoken <= settings->reading.few)
        return READOUT_LEFT;
    words_late(frame, rows, meant, readout->skin.edges, &settings->lateness, readout->late);
    if (memchr(readout->late, 1, frame->nodes))
        return READOUT_ODD;
    memset(spare, 0, settings->spare_count * sizeof *spare);
    for (size_t bit = 0; bit < frame->bits; bit++)
        for (size_t i = 0; i < settings->spare_count; i++)
            spare[i] += fabsf(rows[bit * frame->order + settings->spare + i]);
    for (size_t i = 0; i < settings->spare_count; i++)
        if (spare[i] / (float)frame->bits > settings->lateness.late_share * least)
            return READOUT_ODD;
    return READOUT_PLAIN;
}

/* Whether a doubtful word says that something is on the line: Words.disturbed in decode.py. */
static bool is_disturbed(const struct readout *readout, const struct readout_frame *out)
{
    int disturbed = 0;

    for (size_t i = 0; i < readout->settings.frame.nodes; i++)
        disturbed |= out->doubtful[i] & (out->rho[i] > readout->settings.reading.limits.clear_rho) &
                     !readout->skin.invalid[i];
    return disturbed;
}

/* Adds the words to each node's sums: numpy_count in health.py, of nodes that are not suspect. */
VECTORS static void count(size_t nodes, const struct readout_frame *out,
                          const struct readout_settings *settings, float *restrict sums)
{
    const uint8_t *restrict active = out->active, *restrict doubtful = out->doubtful;
    const uint8_t *restrict doubled = out->doubled, *restrict odd = out->odd;
    const float *restrict amplitude = out->amplitude, *restrict rho = out->rho;
    const float *restrict margin = out->margin;
    const struct words_limits limit = settings->reading.limits;
    const float weak_v = settings->weak_v, weak_rho = settings->weak_rho;

    for (size_t i = 0; i < nodes; i++) {
        int clear = rho[i] > limit.low_rho, weak = margin[i] < limit.low_margin;
        /* Too weak to count as spoken, but too even and too strong to be noise. */
        float heard = (float)(active[i] | ((amplitude[i] > weak_v) & (rho[i] > weak_rho) &
                                           (margin[i] > limit.low_margin)));
        sums[i] += heard;
        sums[nodes + i] += amplitude[i] * heard;
        sums[2 * nodes + i] += (float)(doubtful[i] & clear & weak);
        sums[3 * nodes + i] += (float)doubled[i];
        sums[4 * nodes + i] += (float)(odd[i] & clear & !weak);
    }
}

/* ---- readings ---------------------------------------------------------------------------------- */

/* Takes the words of `size` nodes from number `at` on into what is kept: `hear` in readings/stages.py.
 * raised_v: V, but at rest at least for the highest code. Returns when the oldest word came that is not
 * stale, s. */
INLINE double hear(const struct readout *readout, const struct readout_frame *out, size_t at, size_t size,
                   double now_s, double stale_after_s, float *restrict voltage_v,
                   uint8_t *restrict status)
{
    const struct readout_skin *skin = &readout->skin;
    const struct readout_bits bits = readout->settings.bits;
    const size_t highest = readout->settings.codes - 1;
    const uint8_t *restrict active = out->active + at, *restrict doubtful = out->doubtful + at;
    const uint8_t *restrict state = skin->state + at, *restrict invalid = skin->invalid + at;
    const uint8_t *restrict masked = skin->masked + at;
    int32_t *restrict codes = skin->kept_codes + at;
    uint8_t *restrict flags = skin->kept_flags + at, *restrict valid = out->valid + at;
    double *restrict heard_s = skin->heard_s + at, oldest_s = INFINITY;
    float *restrict raised_v = out->node_v + at;

    for (size_t i = 0; i < size; i++) {
        codes[i] = active[i] ? out->codes[at + i] : codes[i];
        heard_s[i] = active[i] ? now_s : heard_s[i];
        uint8_t uncertain = doubtful[i] ? bits.low_snr : 0;
        flags[i] = active[i] | doubtful[i] ? uncertain : flags[i];
    }
    for (size_t i = 0; i < size; i++) {
        float volts = skin->table_v[codes[i]], rest = skin->rest_v[at + i];
        voltage_v[i] = volts;
        raised_v[i] = (size_t)codes[i] == highest && volts < rest ? rest : volts;
    }
    for (size_t i = 0; i < size; i++) {
        int stale = now_s - heard_s[i] > stale_after_s;
        uint8_t known = flags[i] | state[i] | (active[i] ? 0 : bits.silent);
        status[i] = stale ? bits.silent | bits.stale : known;
        valid[i] = (uint8_t)(!stale & !invalid[i] & !masked[i]);
        oldest_s = !stale & (heard_s[i] < oldest_s) ? heard_s[i] : oldest_s;
    }
    return oldest_s;
}

/* Pressures of the same nodes: `convert` there; and what is beyond the curves' range. */
INLINE void convert(const struct readout *readout, const struct readout_frame *out, size_t at, size_t size,
                    const float *restrict drift_v, float *restrict beyond)
{
    size_t nodes = readout->settings.frame.nodes;
    const float *pieces = readout->skin.pieces + at, *restrict end_v = readout->skin.end_v + at;
    const float *restrict volts = out->node_v + at;
    float *restrict pressure_pa = out->node_pa + at;

    drift_v += at;
    for (size_t i = 0; i < size; i++) {
        pressure_pa[i] = 0;
        beyond[i] = volts[i] + drift_v[i] < end_v[i] ? 1.0f : 0.0f;
    }
    for (size_t piece = 0; piece < readout->settings.pieces; piece++, pieces += 3 * nodes) {
        const float *restrict begin_v = pieces, *restrict width_v = pieces + nodes;
        const float *restrict gain = pieces + 2 * nodes;
        for (size_t i = 0; i < size; i++) {
            float fall_v = begin_v[i] - (volts[i] + drift_v[i]);
            fall_v = fall_v < 0 ? 0 : fall_v;
            fall_v = fall_v > width_v[i] ? width_v[i] : fall_v;
            pressure_pa[i] += fall_v * gain[i];
        }
    }
}

/* Readings of all nodes: `finish` there. */
VECTORS static double read_nodes(const struct readout *readout, const struct readout_frame *out,
                                 double now_s, double stale_after_s, const float *drift_v,
                                 const float *tare_pa, float *restrict pressure_pa,
                                 float *restrict voltage_v, uint8_t *restrict status)
{
    const struct readout_bits bits = readout->settings.bits;
    const uint8_t *restrict uncalibrated = readout->skin.uncalibrated;
    const uint8_t *restrict masked = readout->skin.masked, *restrict valid = out->valid;
    const float *restrict node_pa = out->node_pa;
    size_t nodes = readout->settings.frame.nodes;
    double oldest_s = INFINITY;
    float beyond[BLOCK];

    for (size_t at = 0; at < nodes; at += BLOCK) {
        size_t size = nodes - at < BLOCK ? nodes - at : BLOCK;
        double of_block = hear(readout, out, at, size, now_s, stale_after_s, voltage_v + at, status + at);
        oldest_s = of_block < oldest_s ? of_block : oldest_s;
        convert(readout, out, at, size, drift_v, beyond);
        for (size_t i = at; i < at + size; i++) {
            uint8_t saturated = beyond[i - at] != 0 && valid[i] ? bits.saturated : 0;
            uint8_t all = status[i] | saturated | (uncalibrated[i] ? bits.uncalibrated : 0);
            status[i] = masked[i] ? bits.masked : all;
            pressure_pa[i] = valid[i] ? node_pa[i] - tare_pa[i] : NAN;
            voltage_v[i] = valid[i] ? voltage_v[i] : NAN;
        }
    }
    return oldest_s;
}

enum readout_look readout_read(struct readout *readout, const float *rows, float per_noise,
                               float least_usual, bool in_place, double now_s, double stale_after_s,
                               const float *drift_v, const float *tare_pa,
                               const struct readout_frame *out, double *stale_from_s)
{
    const struct readout_settings *settings = &readout->settings;
    const struct readout_skin *skin = &readout->skin;
    size_t nodes = settings->frame.nodes;
    float *floats = readout->floats;
    struct words_measures measures = {out->amplitude,     floats,         floats + nodes,
                                      floats + 2 * nodes, readout->ints, readout->ints + nodes};
    struct words_decided decided = {out->codes,    out->rho,     out->margin,
                                    out->doubtful, out->doubled, out->odd};
    enum words_look look =
        words_read(&settings->frame, &settings->reading, per_noise, least_usual, rows, skin->sign_mask,
                   skin->expected, &measures, &decided, out->active, readout->late);
    if (look == WORDS_NEED_STAGES || is_disturbed(readout, out))
        return READOUT_ODD;
    if (look == WORDS_LEAVE_ENERGY && !in_place) {
        enum readout_look displaced = find_displaced(readout, rows, out);
        if (displaced != READOUT_PLAIN)
            return displaced;
    }
    count(nodes, out, settings, skin->sums);
    const int32_t *source = skin->source;
    /* Of nodes in scratch, where taxels have another order. */
    float *pressure_pa = source ? floats : out->pressure_pa;
    float *voltage_v = source ? floats + nodes : out->voltage_v;
    uint8_t *status = source ? readout->late : out->status;
    *stale_from_s = stale_after_s + read_nodes(readout, out, now_s, stale_after_s, drift_v, tare_pa,
                                               pressure_pa, voltage_v, status);
    for (size_t i = 0; source && i < settings->taxels; i++) {
        out->pressure_pa[i] = source[i] < 0 ? NAN : pressure_pa[source[i]];
        out->voltage_v[i] = source[i] < 0 ? NAN : voltage_v[source[i]];
        out->status[i] = source[i] < 0 ? settings->bits.masked : status[source[i]];
    }
    return memchr(out->doubtful, 1, nodes) ? READOUT_DOUBTFUL : READOUT_PLAIN;
}
