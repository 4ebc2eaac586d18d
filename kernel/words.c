// SPDX-License-Identifier: Apache-2.0

#include "certifier.h"

#include <math.h>
#include <string.h>

#include "sums.h"

#define HIDDEN_NODE 0.5   /* A²: half of what a node leaves that fits no row, however much others leave */

struct words words_in(uint8_t *memory, size_t nodes)
{
    float *floats = (float *)(void *)memory;
    uint8_t *flags = memory + 16 * nodes;

    return (struct words){.amplitude = floats,
                          .rho = floats + nodes,
                          .margin = floats + 2 * nodes,
                          .codes = (int32_t *)(void *)(floats + 3 * nodes),
                          .active = flags,
                          .doubtful = flags + nodes,
                          .doubled = flags + 2 * nodes,
                          .odd = flags + 3 * nodes,
                          .faint = flags + 4 * nodes};
}

/* ---- measure ----------------------------------------------------------------------------------- */

/* By pointers, for a vector that is passed itself has an ABI only where there is AVX. */
INLINE void replace(const ints8 *where, const floats8 *by, floats8 *values)
{
    *values = (floats8)(((ints8)*by & *where) | ((ints8)*values & ~*where));
}

/* Measures eight nodes, of which `count` are there. */
INLINE void measure_eight(const float *levels, size_t step, size_t bits, const struct words_measures *measures,
                          size_t first, size_t count)
{
    floats8 sum = {0}, most = {0}, squares = {0}, least = sum + INFINITY;
    ints8 signs = {0}, place = {0};

    for (size_t bit = 0; bit < bits; bit++, levels += step) {
        floats8 value = *(const floats8 *)levels, level = (floats8)((ints8)value & INT32_MAX);
        ints8 is_less = level < least, is_more = level > most;
        sum += level;
        squares += level * level;
        place = (place & ~is_less) | ((int32_t)bit & is_less);
        replace(&is_less, &level, &least);
        replace(&is_more, &level, &most);
        signs = signs + signs - (value > 0); /* what is true is −1 */
    }
    sum *= (float)(1.0 / (double)bits);
    memcpy(measures->amplitude + first, &sum, count * sizeof(float));
    memcpy(measures->weakest + first, &least, count * sizeof(float));
    memcpy(measures->strongest + first, &most, count * sizeof(float));
    memcpy(measures->squares + first, &squares, count * sizeof(float));
    memcpy(measures->signs + first, &signs, count * sizeof(int32_t));
    memcpy(measures->weakest_bit + first, &place, count * sizeof(int32_t));
}

VECTORS void words_measure(const float *levels, size_t step, size_t bits, size_t nodes,
                           const struct words_measures *measures)
{
    const size_t whole = nodes & ~(size_t)7;
    float last[WORDS_MOST_BITS * 8] = {0};

    for (size_t first = 0; first < whole; first += 8)
        measure_eight(levels + first, step, bits, measures, first, 8);
    for (size_t bit = 0; bit < bits; bit++)
        memcpy(last + 8 * bit, levels + bit * step + whole, (nodes - whole) * sizeof(float));
    measure_eight(last, 8, bits, measures, whole, nodes - whole);
}

float words_usual(const float *amplitude, size_t nodes, float loud_share, float *loudest)
{
    float first = 0, second = 0, third = 0; /* loudest ones */

    for (size_t i = 0; i < nodes; i++) {
        float level = amplitude[i];
        if (level > third) {
            third = fminf(level, second);
            second = fminf(fmaxf(level, second), first);
            first = fmaxf(level, first);
        }
    }
    *loudest = first;
    return nodes >= 3 && third > loud_share * first ? second : first;
}

/* ---- decide ------------------------------------------------------------------------------------ */

INLINE int odd_of(uint32_t word)
{
    word ^= word >> 16;
    word ^= word >> 8;
    word ^= word >> 4;
    word ^= word >> 2;
    return (int)((word ^ word >> 1) & 1);
}

/* Without branches, and with pointers that are known to differ, so that it is done for many nodes at once: `parity`
 * is a constant where this is inlined. */
INLINE void decide_by(const bool parity, const struct words_measures *measures, const struct code *code,
                      const float *restrict expected, float per_noise, const struct words_limits limit,
                      const struct words *words)
{
    const size_t nodes = code->nodes;
    const uint32_t bits = (uint32_t)code->bits;
    const int32_t *restrict sign_mask = code->sign_mask;
    const float *restrict amplitudes = measures->amplitude, *restrict least = measures->weakest;
    const float *restrict most = measures->strongest;
    const int32_t *restrict signs = measures->signs, *restrict weakest_bit = measures->weakest_bit;
    const uint8_t *restrict active = words->active;
    float *restrict rhos = words->rho, *restrict margins = words->margin;
    int32_t *restrict codes = words->codes;
    uint8_t *restrict doubtful = words->doubtful, *restrict doubled = words->doubled, *restrict odd = words->odd;

    APART
    for (size_t i = 0; i < nodes; i++) {
        float amplitude = amplitudes[i], two = limit.two * expected[i], rho = amplitude * per_noise;
        float margin = least[i] / (amplitude < 1e-30f ? 1e-30f : amplitude);
        int uneven = (margin < limit.clear_margin) | (most[i] > (2 - limit.clear_margin) * amplitude), is_odd = 0;
        int doubt = (rho < limit.low_rho) | (margin < limit.low_margin) | ((rho > limit.even_rho) & uneven);
        uint32_t word = (uint32_t)(signs[i] ^ sign_mask[i]);
        if (parity) {
            is_odd = odd_of(word);
            uint32_t place = (bits - 1 - (uint32_t)weakest_bit[i]) & 31;
            word = (word ^ (uint32_t)is_odd << place) >> 1;
            doubt |= is_odd;
        }
        int cancelling = doubt & (least[i] < limit.low_margin * expected[i]);
        int three = (amplitude > limit.shared * expected[i]) & (rho > limit.clear_rho) &
                    (least[i] < limit.lower * most[i]);
        int twice = (cancelling | three) & (most[i] > two);
        codes[i] = active[i] ? (int32_t)word : 0;
        rhos[i] = rho;
        margins[i] = margin;
        doubtful[i] = (uint8_t)(active[i] & (doubt | twice | (amplitude > two)));
        doubled[i] = (uint8_t)(active[i] & twice);
        odd[i] = (uint8_t)(active[i] & is_odd);
    }
}

VECTORS void words_decide(const struct words_measures *measures, const struct code *code, const float *expected,
                          float per_noise, const struct words_limits *limits, const struct words *words)
{
    if (code->parity)
        decide_by(true, measures, code, expected, per_noise, *limits, words);
    else
        decide_by(false, measures, code, expected, per_noise, *limits, words);
}

/* ---- words of a frame ---------------------------------------------------------------------------- */

VECTORS size_t certifier_speakers(struct certifier *certifier, double noise_v2, const struct words *words, double *weakest)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    float loudest, usual = words_usual(words->amplitude, code->nodes, (float)limits->loud_share, &loudest);
    float *expected = certifier->expected, least = (float)limits->loud_share * loudest;
    const size_t nodes = code->nodes; /* else it is read again after each byte that is written */
    int32_t speakers = 0, weakest_bits = INT32_MAX;

    if (isnan(code->swing)) {
        float floor = (float)(limits->unknown_noise * sqrt(noise_v2 / (double)code->order));
        usual = fmaxf(fmaxf(usual, floor / code->active_share), 1e-9f);
        for (size_t i = 0; i < code->nodes; i++)
            expected[i] = usual;
    }
    const float *amplitude = words->amplitude, share = code->active_share;
    const ints1 *levels = (const ints1 *)amplitude;
    uint8_t *active = words->active;
    APART
    for (size_t i = 0; i < nodes; i++)
        active[i] = (uint8_t)((amplitude[i] > share * expected[i]) & (amplitude[i] > least));
    for (size_t i = 0; i < nodes; i++) { /* bits: those of floats that are not negative rise with the floats */
        int32_t level = levels[i], spoke = active[i];
        level |= INT32_MAX & (spoke - 1);
        weakest_bits = level < weakest_bits ? level : weakest_bits;
        speakers += spoke;
    }
    float weakest_v = INFINITY;
    if (speakers)
        memcpy(&weakest_v, &weakest_bits, sizeof weakest_v);
    *weakest = (double)weakest_v;
    return (size_t)speakers;
}

/* Mean square of noise on a row, V²: what is left, or less where rows that no node has show less. */
static double row_noise(const struct certifier *certifier, const struct reading *reading)
{
    const struct code *code = certifier->code;
    double noise = reading->left / (double)code->order, spare = 0;

    if (code->spare_count < 2)
        return noise;
    for (size_t i = 0; i < code->spare_count; i++)
        spare += (double)certifier->power[code->spare + i];
    return fmin(noise, spare / (double)(code->bits * code->spare_count));
}

/* Marks silent nodes on whose rows there is more than noise; whether there are any. */
VECTORS static bool find_faint(const struct certifier *certifier, const struct reading *reading, const struct words *words)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    double noise = row_noise(certifier, reading), bits = (double)code->bits, swing = reading->swing;
    double chance = certificate_chance(bits, limits->faint_deviations) * noise;
    float least = (float)(bits * fmax(limits->faint * limits->faint * swing * swing, chance));
    float one = (float)fmax(limits->faint_bit * limits->faint_bit * swing * swing,
                            limits->deviations * limits->deviations * noise);
    const float *power = certifier->power + code->first, *most = certifier->most + code->first;
    /* Nobody shows in clipped samples, and what they lack looks like leakage: as much of a row as that may be a node. */
    float shown = reading->view->clipped > 0 ? (float)(limits->faint * swing * (1 - reading->view->clipped)) : INFINITY;
    const float *amplitude = words->amplitude;
    const uint8_t *active = words->active;
    const size_t nodes = code->nodes;
    uint8_t *faint = words->faint, any = 0;

    APART
    for (size_t i = 0; i < nodes; i++) {
        faint[i] = (uint8_t)((active[i] ^ 1) & ((power[i] > least) | (most[i] > one) | (amplitude[i] > shown)));
        any |= faint[i];
    }
    return any;
}

/* ρ of faint nodes, which is told and judges silences, but no words any more: what is on their own rows is none of the
 * noise on these. */
static void measure_faint(const struct certifier *certifier, const struct reading *reading, const struct words *words)
{
    const struct code *code = certifier->code;
    const double order = (double)code->order, tiny = 1e-12 * reading->swing * reading->swing;

    for (size_t i = 0; i < code->nodes; i++)
        if (words->faint[i]) {
            double own = (double)certifier->power[code->first + i] * order;
            double noise = fmax((reading->total - own) / fmax(reading->free - (double)code->bits, 1), tiny);
            words->rho[i] = words->amplitude[i] / (float)sqrt(noise / order);
        }
}

/* Whether a word is weak enough to be a part of one, though its node be known to be weak: a tone makes nodes so. */
static bool any_weak(const struct certifier *certifier, double swing, const struct words *words)
{
    float weak = (float)(certifier->limits.weak * swing);
    int any = 0;

    for (size_t i = 0; i < certifier->code->nodes; i++)
        any |= words->active[i] & (words->amplitude[i] < weak);
    return any;
}

/* Where chips leak into others, or are half a chip off, a row that a delay makes alike holds a part of a word, which
 * counts where its node is known to be weak: there, words that are weaker than such a one, or than a sound one, and
 * have its bits are doubtful. weakest: of all words, V. */
static void doubt_parts(const struct certifier *certifier, double swing, double weakest, const struct words *words)
{
    const struct code *code = certifier->code;
    const int32_t *signs = certifier->measures.signs, all = (int32_t)(UINT32_MAX >> (32 - code->bits));
    const float weak = (float)certifier->limits.weak, sound = (float)swing;
    const float loudest = (float)certifier_greatest(words->amplitude, code->nodes);

    if (weakest >= (double)(weak * fmaxf(loudest, sound)))
        return;
    for (size_t i = 0; i < code->twin_count; i++) {
        const struct code_twin *twin = &code->twins[i];
        int32_t said = twin->share < 0 ? signs[twin->sent] ^ all : signs[twin->sent];
        bool is_part = words->active[twin->sent] && words->active[twin->alike] && said == signs[twin->alike] &&
                       words->amplitude[twin->alike] < weak * fmaxf(words->amplitude[twin->sent], sound);
        words->doubtful[twin->alike] |= is_part;
    }
}

/* Whether the silence of all nodes is uncertain: noise is a tenth of a word, samples are clipped, a node may hide in
 * what is left, or a word is doubtful that is far above noise, which says that there is something else on its row:
 * where that is a second node, also of a broken one. */
VECTORS static bool hides_nodes(const struct certifier *certifier, const struct reading *reading, const struct words *words,
                        double row_noise_v)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    double known = reading->view->noise_v2 * certificate_chance(reading->free, limits->deviations);
    double words_left = limits->left_of_word * limits->left_of_word * (double)reading->speakers;
    double most = (limits->hidden + fmin(words_left, HIDDEN_NODE)) * reading->swing * reading->swing;
    const uint8_t *doubled = words->doubled, *doubtful = words->doubtful, *broken = certifier->broken;
    const float *rho = words->rho, clear_rho = limits->words.clear_rho;
    int clear_doubt = 0;

    if (row_noise_v * limits->silent_rho > reading->swing)
        return true;
    if (reading->view->clipped > limits->faint) /* a row may lack as much of a word as of its samples */
        return true;
    if ((code->scrambled || reading->view->noise_v2 <= 0) && reading->left - known > most)
        return true;
    for (size_t i = 0; i < code->nodes; i++)
        clear_doubt |= doubled[i] | (doubtful[i] & !broken[i] & (rho[i] > clear_rho));
    return clear_doubt;
}

/* Whether what is on row 0 may be the line's level at rest, or a step of it: its bits change once at most. */
static bool may_be_rest(const struct certifier *certifier)
{
    const struct code *code = certifier->code;
    size_t changes = 0;

    for (size_t bit = 1; bit < code->bits; bit++)
        changes += (certifier->rows[bit * code->order] > 0) != (certifier->rows[(bit - 1) * code->order] > 0);
    return changes <= 1;
}

/* Whether the line shows beside a frame that its level is the one at rest, on both sides as far as it is seen there. */
static bool shows_rest(const struct certifier *certifier, const struct reading *reading)
{
    const struct certificate_limits *limits = &certifier->limits;
    const float *beside = certifier->beside;

    for (size_t side = 0; side < 2; side++, beside += reading->side) {
        double sum = 0, count = 0;
        for (size_t i = 0; i < reading->side; i++)
            if (!isnan(beside[i])) {
                sum += (double)beside[i];
                count++;
            }
        double chance = limits->deviations * sqrt(reading->view->noise_v2 / fmax(count, 1));
        if (count > 0 && fabs(sum / count) + chance > (double)certifier->code->active_share * reading->swing)
            return false;
    }
    return true;
}

/* What the word of each node leaves on its row on top of one amplitude, V², where that is too much for one; else 0, as
 * where the node is broken, of which nothing is left. over: (n), all this. Returns how many words leave so much. */
VECTORS static size_t uneven_powers(const struct certifier *certifier, const struct reading *reading,
                                    const struct words *words, float *restrict over)
{
    const double share = certifier->limits.row * reading->swing;
    const float bits = (float)certifier->code->bits, least = (float)(share * share) * bits;
    const float *restrict amplitude = words->amplitude, *restrict squares = certifier->measures.squares;
    const uint8_t *restrict active = words->active, *restrict broken = certifier->broken;
    int32_t count = 0;

    for (size_t i = 0; i < certifier->code->nodes; i++) {
        float more = squares[i] - bits * amplitude[i] * amplitude[i];
        int is_uneven = active[i] & (broken[i] ^ 1) & (more > least);
        over[i] = is_uneven ? more : 0;
        count += is_uneven;
    }
    return (size_t)count;
}

/* Sum of squares of the words' amplitudes, V². */
VECTORS static double power_of_words(const struct certifier *certifier, const struct words *words)
{
    const float *restrict amplitude = words->amplitude;
    const uint8_t *restrict active = words->active;
    float *restrict spoke = certifier->other;

    for (size_t i = 0; i < certifier->code->nodes; i++) {
        float level = amplitude[i];
        spoke[i] = active[i] ? level : 0;
    }
    return sums_power(spoke, certifier->code->nodes);
}

/* Whether a frame that leaves too much leaves no more than noise but for the words of few nodes, which are uneven:
 * then it says what is wrong with these. */
static bool is_understood(const struct certifier *certifier, const struct reading *reading, const struct words *words)
{
    const struct certificate_limits *limits = &certifier->limits;
    const double order = (double)certifier->code->order;
    double noise = reading->view->noise_v2 * certificate_chance(reading->free, limits->deviations);
    double more = limits->left * reading->swing * reading->swing + /* that edges of words as loud as these may leave */
                  limits->left_of_word * limits->left_of_word * power_of_words(certifier, words);
    double total = reading->total;
    size_t uneven = uneven_powers(certifier, reading, words, certifier->mean);

    for (size_t i = 0; uneven && i < certifier->code->nodes; i++)
        total -= (double)certifier->mean[i] * order;
    return (double)uneven <= limits->uneven * (double)(reading->speakers + 1) && total / reading->free < noise + more;
}

/* ρ of the uneven and faint words of a frame that is understood: what is on their rows is none of the noise on these. */
static void measure_odd_ones(const struct certifier *certifier, const struct reading *reading,
                             const struct words *words)
{
    const struct code *code = certifier->code;
    const double order = (double)code->order, bits = (double)code->bits;
    float *own = certifier->mean;
    double total = reading->total, free = reading->free;

    uneven_powers(certifier, reading, words, own);
    for (size_t i = 0; i < code->nodes; i++) {
        own[i] = words->faint[i] ? certifier->power[code->first + i] : own[i];
        total -= (double)own[i] * order;
        free -= own[i] > 0 ? bits : 0;
    }
    double noise = fmax(total / fmax(free, 1), 1e-12 * reading->swing * reading->swing);
    for (size_t i = 0; i < code->nodes; i++)
        if (words->faint[i] || own[i] > 0)
            words->rho[i] = words->amplitude[i] / (float)sqrt(noise / order);
}

/* Whether a frame in which no word is loud enough is explained by words that are all too weak: then the amplitude
 * that is expected is wrong. Faint nodes get the ρ of such words. */
static bool is_weaker(struct certifier *certifier, const struct reading *reading, const struct words *words)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    bool differ;
    double total = certifier_rows_left(certifier, certifier->rows, NULL, &differ), count = 0, power = 0;

    for (size_t i = 0; i < code->nodes; i++) {
        count += certifier->mean[i] > 0;
        power += (double)certifier->mean[i] * (double)certifier->mean[i];
    }
    double left = fmax(total / fmax(reading->free - count, 1), 1e-12 * power);
    double more = certificate_more(limits, count) * power / fmax(count, 1);
    if (count <= 0 || left > reading->view->noise_v2 * certificate_chance(reading->free, limits->deviations) + more)
        return false;
    float per_noise = (float)sqrt((double)code->order / left);
    for (size_t i = 0; i < code->nodes; i++)
        words->rho[i] = words->faint[i] ? words->amplitude[i] * per_noise : words->rho[i];
    return true;
}

bool certifier_doubt(const struct certifier *certifier, const struct reading *reading, const struct words *words,
                     double *value)
{
    doubt_parts(certifier, reading->swing, reading->weakest, words);
    bool any_faint = find_faint(certifier, reading, words);
    *value = any_faint && any_weak(certifier, reading->swing, words) ? 2 : 0;
    if (any_faint)
        measure_faint(certifier, reading, words);
    return any_faint;
}

void certifier_conclude(struct certifier *certifier, const struct reading *reading, const struct words *words,
                        bool any_faint, struct certificate *certificate)
{
    const struct code *code = certifier->code;

    certificate->understood = reading->speakers
                                  ? certificate->value[CLAUSE_REST] < 1 && is_understood(certifier, reading, words)
                                  : any_faint && certificate->value[CLAUSE_ENERGY] > 1 && is_weaker(certifier, reading, words);
    if (reading->speakers && certificate->understood && certificate->value[CLAUSE_ENERGY] > 1)
        measure_odd_ones(certifier, reading, words);
    const uint8_t hidden = hides_nodes(certifier, reading, words, certificate->row_noise_v);
    const uint8_t *active = words->active, *faint = words->faint;
    const size_t nodes = code->nodes;
    uint8_t *doubtful = words->doubtful;
    APART
    for (size_t i = 0; i < nodes; i++)
        doubtful[i] |= faint[i] | (hidden & !active[i]);
    /* Row 0 holds the line's level at rest, too: the word on it, or its silence, may be that. */
    if (code->first == 0 && !code->scrambled && (reading->view->rest_unknown || !shows_rest(certifier, reading)) &&
        may_be_rest(certifier))
        words->doubtful[0] = 1;
}
