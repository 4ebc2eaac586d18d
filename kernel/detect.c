// SPDX-License-Identifier: Apache-2.0

#include "detect.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sums.h"

#define CACHE_LINE 64 /* bytes: where levels begin, so that no eight lie in two lines */
#define LANES 8 /* levels that are looked at at once */
#define APART_BY 16 /* floats between the levels of bits: else all of a code are in one place of the cache */

/* ---- memory -------------------------------------------------------------------------------------- */

struct detector *detector_new(const struct code *code)
{
    const struct sparse_code *book = code->sparse;
    const size_t rows = book->rows, chips = code->bits * code->order, words = code->bits * rows;
    struct detector *detector = calloc(1, sizeof *detector);

    if (!detector)
        return NULL;
    detector->code = *code;
    detector->book = book;
    detector->step = rows + APART_BY;
    const size_t size = 2 * chips + code->bits * detector->step + 2 * words + 6 * rows + CACHE_LINE;
    detector->floats = calloc(size, sizeof(float));
    detector->nodes = malloc(4 * rows * sizeof(int32_t));
    if (!(detector->floats && detector->nodes)) {
        detector_free(detector);
        return NULL;
    }
    detector->sums = (float *)(((uintptr_t)detector->floats + CACHE_LINE - 1) / CACHE_LINE * CACHE_LINE);
    detector->now.words = detector->sums + code->bits * detector->step;
    detector->next.words = detector->now.words + words;
    float **of_codes[] = {&detector->told, &detector->spread, &detector->loud, &detector->belief,
                          &detector->straight, &detector->squares};
    for (size_t i = 0; i < sizeof of_codes / sizeof *of_codes; i++)
        *of_codes[i] = detector->next.words + words + i * rows;
    detector->chips = detector->squares + rows;
    detector->left = detector->chips + chips;
    detector->from = detector->nodes + rows;
    detector->now.codes = detector->from + rows;
    detector->next.codes = detector->now.codes + rows;
    memset(detector->nodes, -1, rows * sizeof *detector->nodes);
    for (size_t node = 0; node < code->nodes; node++)
        detector->nodes[book->numbers[node + 1]] = (int32_t)node;
    return detector;
}

void detector_free(struct detector *detector)
{
    if (!detector)
        return;
    free(detector->floats);
    free(detector->nodes);
    free(detector);
}

/* ---- passes over all codes, those that are listed, or all chips ----------------------------------- */

VECTORS static void flip(size_t count, const float *restrict chips, const float *restrict flips,
                         float *restrict flipped)
{
    for (size_t i = 0; i < count; i++)
        flipped[i] = chips[i] * flips[i];
}

VECTORS static double power_of(const float *values, size_t count)
{
    return sums_power(values, count);
}

/* Takes off the offset of chips that are flipped back, which is returned. */
VECTORS static double take_offset(size_t count, const float *restrict flips, float *restrict left)
{
    double mean = sums_dot(left, flips, count) / (double)count;
    float offset = (float)mean;

    for (size_t i = 0; i < count; i++)
        left[i] -= offset * flips[i];
    return mean;
}

/* What words leave of chips: told are the words' in all places, onsager the share of what was left before. */
VECTORS static void take(size_t count, const float *restrict chips, const float *restrict told,
                         const int32_t *restrict places, float onsager, const float *restrict flips,
                         float offset, float *restrict left)
{
    for (size_t i = 0; i < count; i++)
        left[i] = chips[i] - told[places[i]] + onsager * left[i] - offset * flips[i];
}

/* Means of |r| over the bits, scaled; sums: `step` values from bit to bit. */
VECTORS static void average_loud(size_t rows, size_t bits, size_t step, const float *restrict sums,
                                 float scale, float *restrict loud)
{
    for (size_t i = 0; i < rows; i += LANES) {
        floats8 sum = {0};
        for (size_t bit = 0; bit < bits; bit++)
            sum += (floats8)(*(const ints8 *)(sums + bit * step + i) & INT32_MAX);
        *(floats8 *)(loud + i) = sum * scale;
    }
}

/* How the share of a word that is believed follows from its mean |r|: from the logarithm of its odds. */
struct odds {
    float per, bits, half, odds, span;
};

VECTORS static void believe(size_t rows, const float *restrict loud, const struct odds *of, float *restrict belief)
{
    const struct odds odds = *of; /* the same for all, whatever is written */
    const float turn = 2 * 0.69314718f;

    for (size_t i = 0; i < rows; i++) {
        float u = odds.per * loud[i];
        /* log cosh u is u²/2 for small ones and u − log 2 for large ones: a parabola up to the line. */
        float log_cosh = u < turn ? u * u / (2 * turn) : u - turn / 2;
        float share = 0.5f + (odds.bits * (log_cosh - odds.half) + odds.odds) / odds.span;
        belief[i] = share < 0 ? 0 : share > 1 ? 1 : share;
    }
}

/* Lists the codes that have more than the least; returns how many. Most eights of codes have none, and in others it
 * is a guess who has. */
VECTORS static size_t list_above(size_t rows, const float *restrict values, float least, int32_t *restrict codes)
{
    const floats8 limit = (floats8){0} + least;
    size_t count = 0;

    for (size_t first = 0; first < rows; first += LANES) {
        const ints8 above = *(const floats8 *)(values + first) > limit;
        uint64_t pairs[LANES / 2];
        memcpy(pairs, &above, sizeof pairs);
        bool any = pairs[0] | pairs[1] | pairs[2] | pairs[3];
        for (size_t i = 0; any && i < LANES; i++) {
            codes[count] = (int32_t)(first + i);
            count += values[first + i] > least;
        }
    }
    return count;
}

/* The soft words of one bit of those that will be taken off, by levels that rise to ±1 and the amplitude of a node,
 * V. In the detector's `straight` and `squares`: by how many levels they follow, and those of the bits. */
VECTORS static void say(const struct detector *detector, const float *restrict sums, float rise, float swing,
                        float *restrict words)
{
    const size_t count = detector->next.count;
    const int32_t *restrict codes = detector->next.codes;
    const float *restrict belief = detector->belief;
    float *restrict straight = detector->straight, *restrict squares = detector->squares;

    for (size_t i = 0; i < count; i++) {
        float said = rise * sums[codes[i]];
        said = said < -1 ? -1 : said > 1 ? 1 : said;
        straight[i] += fabsf(said) < 1 ? 1.0f : 0.0f;
        squares[i] += said * said;
        words[i] = swing * belief[i] * said;
    }
}

/* The hard words of one bit. */
VECTORS static void say_hard(size_t count, const int32_t *restrict codes, const float *restrict sums,
                             const float *restrict loud, float *restrict words)
{
    for (size_t i = 0; i < count; i++)
        words[i] = copysignf(loud[codes[i]], sums[codes[i]]);
}

/* ---- levels -------------------------------------------------------------------------------------- */

/* Codes of no node have nothing. */
static void clear_unused(const struct detector *detector, float *values)
{
    values[0] = 0; /* its number is 0 */
    for (size_t row = detector->code.nodes + 1; row < detector->book->rows; row++)
        values[detector->book->numbers[row]] = 0;
}

/* Levels of all codes in what is left of the chips, with the words that were taken off; and how loud each
 * is. Bit by bit, because all of one fits the nearest cache. */
static void correlate(struct detector *detector)
{
    const struct sparse_code *book = detector->book;
    const size_t bits = detector->code.bits, order = detector->code.order;
    const struct listed *now = &detector->now;
    const int32_t *places = book->places;
    const float *left = detector->left;
    float *loud = detector->loud, *spread = detector->spread;

    for (size_t bit = 0; bit < bits; bit++, left += order, places += order) {
        const float *words = now->words + bit * book->rows;
        float *sums = detector_sums(detector, bit);
        for (size_t i = 0; i < order; i++)
            spread[places[i]] = left[i];
        transform_multiply(book->walsh, spread, sums, 1);
        memset(spread, 0, book->rows * sizeof *spread);
        for (size_t i = 0; i < now->count; i++)
            sums[now->codes[i]] += (float)order * words[i];
    }
    average_loud(book->rows, bits, detector->step, detector->sums, 1.0f / (float)(order * bits), loud);
    clear_unused(detector, loud);
}

/* ---- words --------------------------------------------------------------------------------------- */

static void exchange(struct detector *detector)
{
    struct listed now = detector->now;

    detector->now = detector->next;
    detector->next = now;
}

/* Lists those who are believed, and those who were listed, if what they said is kept. */
static void list_believed(struct detector *detector, bool keeps)
{
    const struct listed *now = &detector->now;
    struct listed *next = &detector->next;
    size_t old = 0;

    if (!keeps) {
        next->count = list_above(detector->book->rows, detector->belief, 0, next->codes);
        return;
    }
    next->count = 0;
    for (size_t code = 0; code < detector->book->rows; code++) {
        bool was = old < now->count && (size_t)now->codes[old] == code;
        if (detector->belief[code] > 0 || was) {
            detector->from[next->count] = was ? (int32_t)old : -1;
            next->codes[next->count++] = (int32_t)code;
        }
        old += was;
    }
}

/* Words keep a share of what they were. */
static void fade(const struct detector *detector, float damping)
{
    const struct listed *now = &detector->now, *next = &detector->next;

    for (size_t bit = 0; bit < detector->code.bits; bit++) {
        const float *before = now->words + bit * detector->book->rows;
        float *words = next->words + bit * detector->book->rows;
        for (size_t i = 0; i < next->count; i++)
            words[i] += damping * ((detector->from[i] < 0 ? 0 : before[detector->from[i]]) - words[i]);
    }
}

/* Soft words: of each, the share that is believed, of a bit that rises to ±1. Returns the mean sum of the
 * derivatives of a bit's words by their levels. */
static double soften(struct detector *detector, double noise, double odds, float damping)
{
    const struct sparse_code *book = detector->book;
    struct listed *next = &detector->next;
    double swing = (double)detector->code.swing, per = swing / noise, slopes = 0;
    float rise = (float)(book->slope * per) / (float)detector->code.order;
    struct odds of = {(float)per, (float)detector->code.bits, (float)(swing * per / 2), (float)odds,
                      (float)book->span};
    float *belief = detector->belief, *straight = detector->straight, *squares = detector->squares;

    believe(book->rows, detector->loud, &of, belief);
    clear_unused(detector, belief);
    list_believed(detector, damping > 0);
    for (size_t i = 0; i < next->count; i++) {
        belief[i] = belief[next->codes[i]]; /* codes rise, so that none is overwritten before it is read */
        straight[i] = squares[i] = 0;
    }
    for (size_t bit = 0; bit < detector->code.bits; bit++)
        say(detector, detector_sums(detector, bit), rise, (float)swing, next->words + bit * book->rows);
    for (size_t i = 0; i < next->count; i++) {
        slopes += (double)belief[i] * (double)straight[i] * book->slope;
        slopes += belief[i] > 0 && belief[i] < 1 ? (double)squares[i] / book->span : 0;
    }
    if (damping > 0)
        fade(detector, damping);
    exchange(detector);
    return slopes * swing * per / (double)detector->code.bits;
}

/* The words of those that are loud enough. */
static void harden(struct detector *detector, float least)
{
    const struct sparse_code *book = detector->book;
    struct listed *next = &detector->next;

    next->count = list_above(book->rows, detector->loud, least, next->codes);
    for (size_t bit = 0; bit < detector->code.bits; bit++)
        say_hard(next->count, next->codes, detector_sums(detector, bit), detector->loud,
                        next->words + bit * book->rows);
}

/* Sum of squares of the differences; INFINITY if any two have other signs, or are 0. */
static double distance(size_t count, const float *restrict some, const float *restrict others)
{
    double sum = 0;
    int differ = 0;

    for (size_t i = 0; i < count; i++) {
        differ |= !(some[i] * others[i] > 0);
        sum += (double)(some[i] - others[i]) * (double)(some[i] - others[i]);
    }
    return differ ? INFINITY : sum;
}

/* Power by which the next words change, per chip; INFINITY if they are not the same but for their amplitudes. */
static double change_of(const struct detector *detector)
{
    const struct listed *now = &detector->now, *next = &detector->next;
    double change = 0;

    if (now->count != next->count || memcmp(now->codes, next->codes, now->count * sizeof *now->codes) != 0)
        return INFINITY;
    for (size_t at = 0; at < detector->code.bits * detector->book->rows; at += detector->book->rows)
        change += distance(now->count, next->words + at, now->words + at);
    return change / (double)detector->code.bits;
}

/* ---- what is left -------------------------------------------------------------------------------- */

/* What words leave of the chips, without the offset, which is found anew if it is NAN. */
static void take_off(struct detector *detector, double offset, float onsager)
{
    const struct code *code = &detector->code;
    const struct sparse_code *book = detector->book;
    const struct listed *now = &detector->now;
    float *told = detector->told, *spread = detector->spread;
    float known = isnan(offset) ? 0 : (float)offset;

    for (size_t bit = 0; bit < code->bits; bit++) {
        const float *words = now->words + bit * book->rows;
        size_t first = bit * code->order;
        for (size_t i = 0; i < now->count; i++)
            spread[now->codes[i]] = words[i];
        transform_multiply(book->walsh, spread, told, 1);
        for (size_t i = 0; i < now->count; i++)
            spread[now->codes[i]] = 0;
        take(code->order, detector->chips + first, told, book->places + first, onsager, code->flips + first,
             known, detector->left + first);
    }
    if (isnan(offset))
        detector->offset = take_offset(code->bits * code->order, code->flips, detector->left);
}

/* ---- a frame ------------------------------------------------------------------------------------- */

/* Hard words of levels in which so much was left; whether they are final, which none are that noise would
 * hide. were_hard: those before were; are_whole: what is left is of these alone. */
static bool are_final(struct detector *detector, double power, bool were_hard, bool are_whole)
{
    const struct sparse_code *rules = detector->book;
    const size_t order = detector->code.order, chips = detector->code.bits * order;
    double swing = (double)detector->code.swing, settled = rules->settled;

    double least = rules->hard * sqrt(power / (double)order);
    harden(detector, (float)fmax(rules->least * swing, least));
    double change = detector->change = change_of(detector);
    double most = settled * fmax(power, settled * swing * swing);
    return are_whole && least < swing && (were_hard || change < rules->near * power) &&
           change * (double)detector->next.count / (double)chips < most;
}

/* Turns from the words that were taken off on, until they stay the same. */
static void take_turns(struct detector *detector, bool soft, double damping)
{
    const struct sparse_code *rules = detector->book;
    const size_t chips = detector->code.bits * detector->code.order;
    const double order = (double)detector->code.order;
    const double swing2 = (double)(detector->code.swing * detector->code.swing);
    double before = INFINITY, odds = 0;
    bool were_hard = true, are_whole = true; /* the words before */

    detector->settled = false;
    for (size_t turn = 0; turn < rules->turns; turn++) {
        correlate(detector);
        double power = power_of(detector->left, chips) / (double)chips, noise = power / order;
        if (turn == 0) {
            double share = fmin(fmax(power / swing2, 1) / (double)detector->code.nodes, 0.5);
            odds = log(share / (1 - share));
        }
        if (noise < 1e-12 * swing2) /* not fmax: a frame that is no number does not settle */
            noise = 1e-12 * swing2;
        soft = soft && !(noise < rules->least * rules->least * swing2 || noise > (1 - rules->near) * before);
        before = noise;
        bool is_last = turn + 1 == rules->turns;
        detector->settled = !soft && are_final(detector, power, were_hard, are_whole);
        if (detector->settled || is_last)
            break;
        if (soft) {
            double onsager = soften(detector, noise, odds, (float)damping);
            take_off(detector, detector->offset, (float)(onsager / order));
            are_whole = onsager == 0 && damping == 0;
        } else {
            exchange(detector);
            take_off(detector, NAN, 0);
            are_whole = true;
        }
        were_hard = !soft;
    }
    detector->next.count = soft ? 0 : detector->next.count;
}

void detector_find(struct detector *detector, const float *chips, double damping)
{
    const size_t count = detector->code.bits * detector->code.order;

    detector->now.count = detector->next.count = 0;
    flip(count, chips, detector->code.flips, detector->chips);
    memcpy(detector->left, detector->chips, count * sizeof *chips);
    detector->offset = take_offset(count, detector->code.flips, detector->left);
    take_turns(detector, true, damping);
}

void detector_go_on(struct detector *detector)
{
    take_off(detector, NAN, 0);
    take_turns(detector, false, 0);
}
