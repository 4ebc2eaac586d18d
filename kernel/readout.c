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
    float *floats;   /* (2, n), scratch */
    uint8_t *status; /* (n), scratch */
};

/* Whether sizes fit each other, and what the skin's arrays count is there. */
static bool are_possible(const struct readout_settings *settings, const struct readout_skin *skin)
{
    bool in_range = true;

    for (size_t i = 0; skin->source && i < settings->taxels; i++)
        in_range = in_range && skin->source[i] < (int64_t)settings->nodes;
    for (size_t i = 0; i < settings->nodes; i++)
        in_range = in_range && skin->kept_codes[i] >= 0 && (size_t)skin->kept_codes[i] < settings->codes;
    return in_range && settings->codes && !(settings->codes & (settings->codes - 1)) &&
           (skin->source || settings->taxels == settings->nodes);
}

struct readout *readout_new(const struct readout_settings *settings, const struct readout_skin *skin)
{
    struct readout *readout = are_possible(settings, skin) ? calloc(1, sizeof *readout) : NULL;

    if (!readout)
        return NULL;
    readout->settings = *settings;
    readout->skin = *skin;
    readout->floats = malloc(2 * settings->nodes * sizeof(float));
    readout->status = malloc(settings->nodes);
    if (readout->floats && readout->status)
        return readout;
    readout_free(readout);
    return NULL;
}

void readout_free(struct readout *readout)
{
    free(readout->floats);
    free(readout->status);
    free(readout);
}

/* ---- words ------------------------------------------------------------------------------------- */

/* Whether a flag is set: 0 or 1 of each node. */
static bool any(const uint8_t *flags, size_t nodes)
{
    return memchr(flags, 1, nodes) != NULL;
}

/* Adds the words to what is known of their nodes. Of most frames no word has a flag. */
VECTORS static void count(const struct words *words, const struct readout_settings *settings, float *restrict sums)
{
    const size_t nodes = settings->nodes;
    const uint8_t *restrict active = words->active, *restrict doubtful = words->doubtful;
    const uint8_t *restrict doubled = words->doubled, *restrict odd = words->odd, *restrict faint = words->faint;
    const float *restrict amplitude = words->amplitude, *restrict rho = words->rho, *restrict margin = words->margin;
    const struct readout_settings limit = *settings;

    for (size_t i = 0; i < nodes; i++) {
        sums[i] += (float)active[i];
        sums[nodes + i] += amplitude[i] * (float)active[i];
    }
    if (!(any(doubtful, nodes) || any(doubled, nodes) || any(odd, nodes) || any(faint, nodes)))
        return;
    for (size_t i = 0; i < nodes; i++) {
        int clear = rho[i] > limit.low_rho, weak = margin[i] < limit.low_margin;
        float heard = (float)(faint[i] & (amplitude[i] > limit.weak) & (rho[i] > limit.weak_rho) & !weak);
        sums[i] += heard;
        sums[nodes + i] += amplitude[i] * heard;
        sums[2 * nodes + i] += (float)(active[i] & doubtful[i] & clear & weak);
        sums[3 * nodes + i] += (float)doubled[i];
        sums[4 * nodes + i] += (float)(odd[i] & clear & !weak);
        sums[5 * nodes + i] += (float)faint[i];
    }
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

/* Takes words into what is kept of the nodes. */
VECTORS static void keep_words(const struct readout_skin *skin, const struct words *words,
                               double now_s, double stale_after_s, struct block *block)
{
    const size_t size = block->size;
    const uint8_t *restrict active = words->active + block->at;
    const int32_t *restrict said = words->codes + block->at;
    int32_t *restrict codes = skin->kept_codes + block->at;
    double *restrict heard_s = skin->heard_s + block->at;
    uint8_t *restrict stale = block->stale;

    for (size_t i = 0; i < size; i++) {
        int32_t before = codes[i], now = said[i];
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
        volts[i] = table_v[codes[i] & highest]; /* there are a power of 2 */
    for (size_t i = 0; i < size; i++) {
        float pulled_v = sign[i] * (rest_v[i] - volts[i]);
        int at_end = codes[i] == (sign[i] > 0 ? highest : 0), pulled = pulled_v > 0;
        hiding[i] = (uint8_t)(at_end & (pulled_v > margin_v[i]));
        meant_v[at + i] = at_end & pulled ? rest_v[i] : volts[i];
    }
}

/* Pressures, which are beyond the curves' range, and which are off rest: Curves.pressure, and PressureChain.update. */
VECTORS static void convert(const struct readout *readout, const float *restrict meant_v,
                            const float *restrict drift_v, float *restrict node_pa, struct block *block)
{
    const size_t at = block->at, size = block->size, nodes = readout->settings.nodes;
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

/* Readings of a block of nodes and their status, see Status in readings/status.py. */
VECTORS static void finish(const struct readout *readout, const struct words *words, uint8_t *valids,
                           const float *restrict tare_pa, struct block *block,
                           float *restrict pressures_pa, float *restrict voltages_v,
                           uint8_t *restrict statuses)
{
    const struct readout_bits bits = readout->settings.bits;
    const struct readout_skin *skin = &readout->skin;
    const size_t at = block->at, size = block->size;
    const uint8_t *restrict active = words->active + at, *restrict doubtful = words->doubtful + at;
    const uint8_t *restrict state = skin->state + at, *restrict invalid = skin->invalid + at;
    const uint8_t *restrict masked = skin->masked + at, *restrict bare = skin->uncalibrated + at;
    const uint8_t *restrict beyond = block->beyond, *restrict stale = block->stale;
    const uint8_t *restrict hiding = block->hiding, *restrict off_rest = block->off_rest;
    uint8_t *restrict readable = block->readable;
    uint8_t *restrict flags = skin->kept_flags + at, *restrict valid = valids + at;
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

/* Readings of nodes → of taxels, where these have another order. */
static void place(const struct readout *readout, const struct readout_frame *out)
{
    const struct readout_settings *settings = &readout->settings;
    const int32_t *source = readout->skin.source;
    const float *voltage_v = readout->floats + settings->nodes;

    for (size_t i = 0; i < settings->taxels; i++) {
        bool is_bare = source[i] < 0;
        out->pressure_pa[i] = is_bare ? NAN : readout->floats[source[i]];
        out->voltage_v[i] = is_bare ? NAN : voltage_v[source[i]];
        out->status[i] = is_bare ? settings->bits.masked : readout->status[source[i]];
    }
}

void readout_read(struct readout *readout, const struct words *words, bool counts, double now_s, double stale_after_s,
                  const float *drift_v, const float *tare_pa, const struct readout_frame *out)
{
    const struct readout_settings *settings = &readout->settings;
    const struct readout_skin *skin = &readout->skin;
    const size_t nodes = settings->nodes;
    const int32_t *source = skin->source;
    /* Of nodes in scratch, where taxels have another order. */
    float *pressure_pa = source ? readout->floats : out->pressure_pa;
    float *voltage_v = source ? readout->floats + nodes : out->voltage_v;
    uint8_t *status = source ? readout->status : out->status;

    if (counts)
        count(words, settings, skin->sums);
    for (struct block block = {.at = 0}; block.at < nodes; block.at += BLOCK) {
        block.size = nodes - block.at < BLOCK ? nodes - block.at : BLOCK;
        keep_words(skin, words, now_s, stale_after_s, &block);
        look_up(skin, (int32_t)settings->codes - 1, out->node_v, &block);
        convert(readout, out->node_v, drift_v, out->node_pa, &block);
        finish(readout, words, out->valid, tare_pa, &block, pressure_pa, voltage_v, status);
    }
    if (source)
        place(readout, out);
}
