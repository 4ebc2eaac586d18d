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

/* Whether sizes fit each other, and what the skin's arrays count is there. */
static bool are_possible(const struct readout_settings *settings, const struct readout_skin *skin)
{
    const struct words_frame *frame = &settings->frame;
    size_t codes = settings->codes;
    bool in_range = true;

    for (size_t i = 0; skin->source && i < settings->taxels; i++)
        in_range = in_range && skin->source[i] < (int64_t)frame->nodes;
    for (size_t i = 0; i < frame->nodes; i++)
        in_range = in_range && skin->kept_codes[i] >= 0 && (size_t)skin->kept_codes[i] < codes;
    return in_range && frame->bits > settings->reading.parity && frame->bits <= WORDS_MOST_BITS &&
           codes == (size_t)1 << (frame->bits - settings->reading.parity) && settings->scrambled == !!skin->offset &&
           (skin->source || settings->taxels == frame->nodes) && frame->first <= frame->order &&
           frame->nodes <= frame->order - frame->first && settings->spare <= frame->order &&
           settings->spare_count <= frame->order - settings->spare;
}

struct readout *readout_new(const struct readout_settings *settings, const struct readout_skin *skin)
{
    struct readout *readout = are_possible(settings, skin) ? calloc(1, sizeof *readout) : NULL;
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
 * known: `out_of_place` in lateness.py, but for scrambled frames, what leaks, and the delays that it compares
 * of few words, of which Python is asked. */
static enum readout_look find_displaced(struct readout *readout, const float *rows, const struct readout_frame *out)
{
    const struct readout_settings *settings = &readout->settings;
    const struct words_frame *frame = &settings->frame;
    float *meant = readout->floats + 4 * frame->nodes, *spare = meant + frame->order;
    float least = INFINITY;
    size_t spoken = 0;

    memset(meant, 0, frame->order * sizeof *meant);
    for (size_t i = 0; i < frame->nodes; i++) {
        spoken += out->active[i];
        meant[frame->first + i] = out->active[i] ? out->amplitude[i] : 0.0f;
        least = out->active[i] && out->amplitude[i] < least ? out->amplitude[i] : least;
    }
    if (settings->scrambled)
        return READOUT_LEFT;
    bool are_few = spoken <= settings->reading.few;
    words_late(frame, rows, meant, readout->skin.edges, &settings->lateness, readout->late);
    if (memchr(readout->late, 1, frame->nodes))
        return are_few ? READOUT_LEFT : READOUT_ODD;
    memset(spare, 0, settings->spare_count * sizeof *spare);
    for (size_t bit = 0; bit < frame->bits; bit++)
        for (size_t i = 0; i < settings->spare_count; i++)
            spare[i] += fabsf(rows[bit * frame->order + settings->spare + i]);
    for (size_t i = 0; i < settings->spare_count; i++)
        if (spare[i] / (float)frame->bits > settings->lateness.late_share * least)
            return READOUT_ODD;
    return are_few ? READOUT_FEW : READOUT_PLAIN;
}

/* Whether a doubtful word says that something is on the line: Words.disturbed in decode.py. */
static bool is_disturbed(const struct readout *readout, const struct readout_frame *out)
{
    int disturbed = 0;

    if (!memchr(out->doubtful, 1, readout->settings.frame.nodes))
        return false;
    for (size_t i = 0; i < readout->settings.frame.nodes; i++)
        disturbed |= out->doubled[i] |
                     (out->doubtful[i] & !readout->skin.invalid[i] &
                      (out->rho[i] > readout->settings.reading.limits.clear_rho));
    return disturbed;
}

/* Adds the words of nodes to their sums: count in health.py, of nodes that are not suspect. some: which; NULL:
 * the first ones. */
INLINE void count_these(const int32_t *some, size_t number, const struct readout_frame *out,
                        const struct readout_settings *settings, float *restrict sums)
{
    const size_t nodes = settings->frame.nodes;
    const uint8_t *restrict active = out->active, *restrict doubtful = out->doubtful;
    const uint8_t *restrict doubled = out->doubled, *restrict odd = out->odd;
    const float *restrict amplitude = out->amplitude, *restrict rho = out->rho;
    const float *restrict margin = out->margin;
    const struct words_limits limit = settings->reading.limits;

    for (size_t at = 0; at < number; at++) {
        size_t i = some ? (size_t)some[at] : at;
        int clear = rho[i] > limit.low_rho, weak = margin[i] < limit.low_margin;
        float heard = (float)active[i];
        sums[i] += heard;
        sums[nodes + i] += amplitude[i] * heard;
        sums[2 * nodes + i] += (float)(doubtful[i] & clear & weak);
        sums[3 * nodes + i] += (float)doubled[i];
        sums[4 * nodes + i] += (float)(odd[i] & clear & !weak);
    }
}

VECTORS static void count(size_t nodes, const struct readout_frame *out,
                          const struct readout_settings *settings, float *sums)
{
    count_these(NULL, nodes, out, settings, sums);
}

/* ---- readings ---------------------------------------------------------------------------------- */

/* The nodes from number `at` on, which go through these steps together. Loops are short, without branches
 * and on arrays that are known to differ, so that they are done for many nodes at once; flags are 0 or 1,
 * thus −flag a mask. */
struct block {
    size_t at, size;
    float volts[BLOCK], pressure_pa[BLOCK];
    uint8_t hiding[BLOCK], beyond[BLOCK], off_rest[BLOCK], stale[BLOCK], readable[BLOCK];
};

/* Takes words into what is kept of the nodes: Taxels._hear in readings/taxels.py. */
VECTORS static void keep_words(const struct readout_skin *skin, const struct readout_frame *out,
                               double now_s, double stale_after_s, struct block *block)
{
    const size_t size = block->size;
    const uint8_t *restrict active = out->active + block->at;
    const int32_t *restrict words = out->codes + block->at;
    int32_t *restrict codes = skin->kept_codes + block->at;
    double *restrict heard_s = skin->heard_s + block->at;
    uint8_t *restrict stale = block->stale;

    for (size_t i = 0; i < size; i++) {
        int32_t before = codes[i], now = words[i];
        codes[i] = active[i] ? now : before;
    }
    for (size_t i = 0; i < size; i++) {
        double before_s = heard_s[i];
        heard_s[i] = active[i] ? now_s : before_s;
    }
    for (size_t i = 0; i < size; i++)
        stale[i] = now_s - heard_s[i] > stale_after_s;
}

/* Looks up voltages; meant_v: at rest, for a code at the converter's end that may hide a contact. */
VECTORS static void look_up(const struct readout_skin *skin, int32_t highest, float *restrict meant_v,
                            struct block *block)
{
    const size_t at = block->at, size = block->size;
    const int32_t *restrict codes = skin->kept_codes + at;
    const float *restrict table_v = skin->table_v, *restrict rest_v = skin->rest_v + at;
    const float *restrict sign = skin->sign + at, *restrict margin_v = skin->margin_v + at;
    float *restrict volts = block->volts;
    uint8_t *restrict hiding = block->hiding;

    for (size_t i = 0; i < size; i++)
        volts[i] = table_v[codes[i]];
    for (size_t i = 0; i < size; i++) {
        float pulled_v = sign[i] * (rest_v[i] - volts[i]);
        int at_end = codes[i] == (sign[i] > 0 ? highest : 0), pulled = pulled_v > 0;
        hiding[i] = (uint8_t)(at_end & (pulled_v > margin_v[i]));
        meant_v[at + i] = at_end & pulled ? rest_v[i] : volts[i];
    }
}

/* Pressures, which are beyond the curves' range, and which are off rest: Curves.pressure, and
 * PressureChain.update. */
VECTORS static void convert(const struct readout *readout, const float *restrict meant_v,
                            const float *restrict drift_v, float *restrict node_pa, struct block *block)
{
    const size_t at = block->at, size = block->size, nodes = readout->settings.frame.nodes;
    const float *restrict pieces = readout->skin.pieces + at, *restrict end_v = readout->skin.end_v + at;
    const float *restrict rest_v = readout->skin.rest_v + at;
    const float *restrict margin_v = readout->skin.margin_v + at, *restrict sign = readout->skin.sign + at;
    float *restrict pressure_pa = block->pressure_pa;
    uint8_t *restrict beyond = block->beyond, *restrict off_rest = block->off_rest;

    for (size_t i = 0; i < size; i++) {
        pressure_pa[i] = 0;
        beyond[i] = (meant_v[at + i] + drift_v[at + i] - end_v[i]) * sign[i] < 0;
        off_rest[i] = (meant_v[at + i] + drift_v[at + i] - rest_v[i]) * sign[i] > margin_v[i];
    }
    for (size_t piece = 0; piece < readout->settings.pieces; piece++, pieces += 3 * nodes)
        for (size_t i = 0; i < size; i++) {
            float below_v = pieces[i] - (meant_v[at + i] + drift_v[at + i]);
            float passed_pa = below_v * pieces[nodes + i], width_pa = pieces[2 * nodes + i];
            passed_pa = passed_pa < 0 ? 0 : passed_pa;
            pressure_pa[i] += passed_pa > width_pa ? width_pa : passed_pa;
        }
    for (size_t i = 0; i < size; i++)
        node_pa[at + i] = pressure_pa[i];
}

/* Readings and their status: the rest of Taxels._hear, and Taxels._finished. */
VECTORS static void finish(const struct readout *readout, const struct readout_frame *out,
                           const float *restrict tare_pa, struct block *block,
                           float *restrict pressures_pa, float *restrict voltages_v,
                           uint8_t *restrict statuses)
{
    const struct readout_bits bits = readout->settings.bits;
    const struct readout_skin *skin = &readout->skin;
    const size_t at = block->at, size = block->size;
    const uint8_t *restrict active = out->active + at, *restrict doubtful = out->doubtful + at;
    const uint8_t *restrict state = skin->state + at, *restrict invalid = skin->invalid + at;
    const uint8_t *restrict masked = skin->masked + at, *restrict bare = skin->uncalibrated + at;
    const uint8_t *restrict beyond = block->beyond, *restrict stale = block->stale;
    const uint8_t *restrict hiding = block->hiding, *restrict off_rest = block->off_rest;
    uint8_t *restrict readable = block->readable;
    uint8_t *restrict flags = skin->kept_flags + at, *restrict valid = out->valid + at;
    uint8_t *restrict status = statuses + at;
    float *restrict pressure_pa = pressures_pa + at, *restrict voltage_v = voltages_v + at;

    APART
    for (size_t i = 0; i < size; i++) {
        uint8_t is_new = (uint8_t)-(active[i] | doubtful[i]), old = (uint8_t)-stale[i];
        uint8_t out_of_use = (uint8_t)-masked[i], is_valid = !(stale[i] | invalid[i] | masked[i]);
        uint8_t flag = (flags[i] & (uint8_t)~is_new) | (bits.low_snr & (uint8_t)-doubtful[i]);
        uint8_t known = flag | state[i] | (bits.silent & (uint8_t)(active[i] - 1));
        uint8_t all = (known & (uint8_t)~old) | ((bits.silent | bits.stale) & old);
        all |= bits.saturated & (uint8_t)-((beyond[i] | hiding[i]) & is_valid);
        all |= bits.faulty & (uint8_t)-(off_rest[i] & is_valid);
        all |= bits.uncalibrated & (uint8_t)-bare[i];
        flags[i] = flag;
        valid[i] = is_valid; /* a tare may make a rest of it */
        readable[i] = is_valid & !off_rest[i];
        status[i] = (all & (uint8_t)~out_of_use) | (bits.masked & out_of_use);
    }
    for (size_t i = 0; i < size; i++) {
        float reading_pa = block->pressure_pa[i] - tare_pa[at + i], volts = block->volts[i];
        pressure_pa[i] = readable[i] ? reading_pa : NAN;
        voltage_v[i] = readable[i] ? volts : NAN;
    }
}

enum readout_look readout_read(struct readout *readout, const float *rows, const int32_t *spoke,
                               size_t speakers, float per_noise,
                               float least_usual, bool in_place, double now_s, double stale_after_s,
                               const float *drift_v, const float *tare_pa,
                               const struct readout_frame *out)
{
    const struct readout_settings *settings = &readout->settings;
    const struct readout_skin *skin = &readout->skin;
    size_t nodes = settings->frame.nodes;
    float *floats = readout->floats;
    struct words_measures measures = {spoke ? floats + 3 * nodes : out->amplitude, floats, floats + nodes,
                                      floats + 2 * nodes, readout->ints, readout->ints + nodes};
    struct words_decided decided = {out->codes,    out->rho,     out->margin,
                                    out->doubtful, out->doubled, out->odd};
    enum words_look look =
        spoke ? words_read_some(&settings->frame, &settings->reading, per_noise, least_usual, rows, spoke, speakers,
                                skin->sign_mask, skin->expected, &measures, out->amplitude, &decided, out->active)
              : words_read(&settings->frame, &settings->reading, per_noise, least_usual, rows, skin->sign_mask,
                           skin->offset, skin->expected, &measures, &decided, out->active);
    if (look == WORDS_NEED_STAGES || is_disturbed(readout, out))
        return READOUT_ODD;
    if (look == WORDS_LEAVE_MUCH && !in_place)
        return READOUT_LEFT;
    if (look == WORDS_LEAVE_ENERGY && !in_place) {
        enum readout_look displaced = find_displaced(readout, rows, out);
        if (displaced != READOUT_PLAIN)
            return displaced;
    }
    if (spoke)
        count_these(spoke, speakers, out, settings, skin->sums);
    else
        count(nodes, out, settings, skin->sums);
    const int32_t *source = skin->source;
    /* Of nodes in scratch, where taxels have another order. */
    float *pressure_pa = source ? floats : out->pressure_pa;
    float *voltage_v = source ? floats + nodes : out->voltage_v;
    uint8_t *status = source ? readout->late : out->status;
    struct block block = {.at = 0};
    for (; block.at < nodes; block.at += BLOCK) {
        block.size = nodes - block.at < BLOCK ? nodes - block.at : BLOCK;
        keep_words(skin, out, now_s, stale_after_s, &block);
        look_up(skin, (int32_t)settings->codes - 1, out->node_v, &block);
        convert(readout, out->node_v, drift_v, out->node_pa, &block);
        finish(readout, out, tare_pa, &block, pressure_pa, voltage_v, status);
    }
    for (size_t i = 0; source && i < settings->taxels; i++) {
        out->pressure_pa[i] = source[i] < 0 ? NAN : pressure_pa[source[i]];
        out->voltage_v[i] = source[i] < 0 ? NAN : voltage_v[source[i]];
        out->status[i] = source[i] < 0 ? settings->bits.masked : status[source[i]];
    }
    return memchr(out->doubtful, 1, nodes) ? READOUT_DOUBTFUL : READOUT_PLAIN;
}
