// SPDX-License-Identifier: Apache-2.0

#include "detect.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "vectors.h"

#define LANES 8 /* sums that are kept apart, so that they can be added at once */
#define CACHE_LINE 64 /* bytes: at its begin begin arrays, so that no eight values lie in two lines */
#define APART_BY 16 /* floats between the levels of bits: else all of a code are in one place of the cache */

/* ---- passes -------------------------------------------------------------------------------------- */

/* Over the levels of all codes, those that are listed, or all chips. Where many values are added, sums are in double,
 * and in the same order on every processor. */

VECTORS static double mean_of(const float *chips, size_t count)
{
    double sums[LANES] = {0}, sum = 0;
    size_t i = 0;

    for (; i + LANES <= count; i += LANES)
        for (size_t lane = 0; lane < LANES; lane++)
            sums[lane] += (double)chips[i + lane];
    for (; i < count; i++)
        sum += (double)chips[i];
    for (size_t lane = 0; lane < LANES; lane++)
        sum += sums[lane];
    return sum / (double)count;
}

VECTORS static double product(size_t count, const float *restrict some, const float *restrict others)
{
    double sums[LANES] = {0}, sum = 0;
    size_t i = 0;

    for (; i + LANES <= count; i += LANES)
        for (size_t lane = 0; lane < LANES; lane++)
            sums[lane] += (double)some[i + lane] * (double)others[i + lane];
    for (; i < count; i++)
        sum += (double)some[i] * (double)others[i];
    for (size_t lane = 0; lane < LANES; lane++)
        sum += sums[lane];
    return sum;
}

VECTORS static void flip(size_t count, const float *restrict chips, const float *restrict flips,
                         float *restrict flipped)
{
    for (size_t i = 0; i < count; i++)
        flipped[i] = chips[i] * flips[i];
}

/* Chips, which may be `left`, without the level. */
VECTORS static void shift(size_t count, const float *chips, const float *restrict flips, float level, float *left)
{
    APART
    for (size_t i = 0; i < count; i++)
        left[i] = chips[i] - level * flips[i];
}

/* What words leave of chips: told are the words' in all places, onsager the share of what was left before. */
VECTORS static void take(size_t count, const float *restrict chips, const float *restrict told,
                         const int32_t *restrict places, float onsager, const float *restrict flips, float level,
                         float *restrict left)
{
    for (size_t i = 0; i < count; i++)
        left[i] = chips[i] - told[places[i]] + onsager * left[i] - level * flips[i];
}

/* Means of |r| over the bits, scaled; sums: `step` values from bit to bit. */
VECTORS static void average_loud(size_t rows, size_t bits, size_t step, const float *restrict sums, float scale,
                                 float *restrict loud)
{
    for (size_t i = 0; i < rows; i += LANES) {
        floats8 sum = {0};
        for (size_t bit = 0; bit < bits; bit++)
            sum += (floats8)(*(const ints8 *)(sums + bit * step + i) & INT32_MAX);
        *(floats8 *)(loud + i) = sum * scale;
    }
}

/* How the share of a word that is believed follows from its mean |r|: a straight line of the logarithm of its odds, in
 * which log cosh u, u²/2 for small u and u − log 2 for large ones, is a parabola up to that line. */
struct odds {
    float per, bits, half, odds, span;
};

INLINE float share_of(float loud, const struct odds *of)
{
    const float turn = 2 * 0.69314718f;
    float u = of->per * loud;
    float log_cosh = u < turn ? u * u / (2 * turn) : u - turn / 2;
    float share = 0.5f + (of->bits * (log_cosh - of->half) + of->odds) / of->span;

    return share < 0 ? 0 : share > 1 ? 1 : share;
}

VECTORS static void believe(size_t rows, const float *restrict loud, const struct odds *of,
                            float *restrict belief)
{
    const struct odds odds = *of; /* the same for all, whatever is written */

    for (size_t i = 0; i < rows; i++)
        belief[i] = share_of(loud[i], &odds);
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

/* The soft words of one bit. straight, squares: by how many levels they follow, and those of the bits. */
VECTORS static void say(size_t count, const int32_t *restrict codes, const float *restrict sums, float rise,
                        const float *restrict swings, float *restrict words, float *restrict straight,
                        float *restrict squares)
{
    for (size_t i = 0; i < count; i++) {
        float said = rise * sums[codes[i]];
        said = said < -1 ? -1 : said > 1 ? 1 : said;
        straight[i] += fabsf(said) < 1 ? 1.0f : 0.0f;
        squares[i] += said * said;
        words[i] = swings[i] * said;
    }
}

/* The hard words of one bit. */
VECTORS static void say_hard(size_t count, const int32_t *restrict codes, const float *restrict sums,
                             const float *restrict loud, float *restrict words)
{
    for (size_t i = 0; i < count; i++)
        words[i] = copysignf(loud[codes[i]], sums[codes[i]]);
}

/* Sum of squares of the differences; INFINITY if any two have other signs, or are 0. */
VECTORS static double distance(size_t count, const float *restrict some, const float *restrict others)
{
    double sums[LANES] = {0}, sum = 0;
    int differ = 0;
    size_t i = 0;

    for (; i + LANES <= count; i += LANES)
        for (size_t lane = 0; lane < LANES; lane++) {
            float a = some[i + lane], b = others[i + lane];
            differ |= !(a * b > 0);
            sums[lane] += (double)(a - b) * (double)(a - b);
        }
    for (; i < count; i++) {
        differ |= !(some[i] * others[i] > 0);
        sum += (double)(some[i] - others[i]) * (double)(some[i] - others[i]);
    }
    for (size_t lane = 0; lane < LANES; lane++)
        sum += sums[lane];
    return differ ? INFINITY : sum;
}

/* ---- memory -------------------------------------------------------------------------------------- */

static bool make_list(struct listed *list, const struct sparse_book *book)
{
    list->codes = malloc(book->rows * sizeof *list->codes);
    list->words = malloc(book->bits * book->rows * sizeof *list->words);
    return list->codes && list->words;
}

/* So many floats more of what is left of the memory, from the next cache line on. */
static float *part_of(float **left, size_t count)
{
    const size_t line = CACHE_LINE / sizeof **left;
    float *part = *left;

    *left += (count + line - 1) / line * line;
    return part;
}

struct detector *detector_new(const struct sparse_book *book, const struct detect_rules *rules)
{
    const size_t chips = book->bits * book->order, step = book->rows + APART_BY, parts = 11;
    const size_t size = (2 * chips + book->bits * step + 8 * book->rows) * sizeof(float);
    struct detector *detector = calloc(1, sizeof *detector);

    if (!detector)
        return NULL;
    detector->book = *book;
    detector->rules = *rules;
    detector->step = step;
    detector->memory = calloc(1, size + (parts + 1) * CACHE_LINE);
    detector->unused = malloc(4 * book->rows * sizeof(int32_t));
    if (!(detector->memory && detector->unused && make_list(&detector->now, book) &&
          make_list(&detector->next, book))) {
        detector_free(detector);
        return NULL;
    }
    float *left = (float *)(((uintptr_t)detector->memory + CACHE_LINE - 1) / CACHE_LINE * CACHE_LINE);
    detector->chips = part_of(&left, chips);
    detector->left = part_of(&left, chips);
    detector->sums = part_of(&left, book->bits * step);
    float **of_codes[] = {&detector->told, &detector->spread, &detector->loud, &detector->belief,
                          &detector->straight, &detector->squares, &detector->amplitude, &detector->swings};
    for (size_t i = 0; i < sizeof of_codes / sizeof *of_codes; i++)
        *of_codes[i] = part_of(&left, book->rows);
    detector->carried = detector->unused + book->rows;
    detector->from = detector->carried + book->rows;
    detector->nodes = detector->from + book->rows;
    for (size_t row = 0; row < book->rows; row++) {
        bool is_node = row > 0 && row <= book->nodes;
        detector->amplitude[row] = (float)rules->swing;
        detector->nodes[book->codes[row]] = is_node ? (int32_t)row - 1 : -1;
        if (!is_node)
            detector->unused[detector->unused_count++] = book->codes[row];
    }
    return detector;
}

void detector_free(struct detector *detector)
{
    if (!detector)
        return;
    free(detector->memory);
    free(detector->unused);
    free(detector->now.codes);
    free(detector->now.words);
    free(detector->next.codes);
    free(detector->next.words);
    free(detector);
}

/* ---- levels -------------------------------------------------------------------------------------- */

/* Levels of all codes in what is left of the chips, with the words that were taken off; and how loud each is. Bit by
 * bit, because all of one fits the nearest cache. */
static void correlate(struct detector *detector)
{
    const struct sparse_book *book = &detector->book;
    const struct listed *now = &detector->now;
    const int32_t *places = book->places;
    const float *left = detector->left;
    float *loud = detector->loud, *spread = detector->spread, order = (float)book->order;

    for (size_t bit = 0; bit < book->bits; bit++, left += book->order, places += book->order) {
        const float *words = now->words + bit * book->rows;
        float *sums = detector_sums(detector, bit);
        for (size_t i = 0; i < book->order; i++)
            spread[places[i]] = left[i];
        transform_multiply(book->walsh, spread, sums, 1);
        memset(spread, 0, book->rows * sizeof *spread);
        for (size_t i = 0; i < now->count; i++)
            sums[now->codes[i]] += order * words[i];
    }
    average_loud(book->rows, book->bits, detector->step, detector->sums, 1.0f / (order * (float)book->bits),
                        loud);
    for (size_t i = 0; i < detector->unused_count; i++)
        loud[detector->unused[i]] = 0;
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
        next->count = list_above(detector->book.rows, detector->belief, 0, next->codes);
        return;
    }
    next->count = 0;
    for (size_t code = 0; code < detector->book.rows; code++) {
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

    for (size_t bit = 0; bit < detector->book.bits; bit++) {
        const float *before = now->words + bit * detector->book.rows;
        float *words = next->words + bit * detector->book.rows;
        for (size_t i = 0; i < next->count; i++)
            words[i] += damping * ((detector->from[i] < 0 ? 0 : before[detector->from[i]]) - words[i]);
    }
}

/* Those who spoke in the frame before do as likely as not, whatever others do. */
static void believe_carried(struct detector *detector, struct odds odds)
{
    odds.odds = 0;
    for (size_t i = 0; i < detector->carried_count; i++) {
        size_t code = (size_t)detector->carried[i];
        detector->belief[code] = fmaxf(detector->belief[code], share_of(detector->loud[code], &odds));
    }
}

/* Soft words of those that are believed; returns the mean sum of the derivatives of a bit's words by their levels.
 * damping: also says that what earlier frames told is not used. */
static double soften(struct detector *detector, double noise, double odds, float damping)
{
    const struct sparse_book *book = &detector->book;
    const struct detect_rules *rules = &detector->rules;
    struct listed *next = &detector->next;
    double per = rules->swing / noise, slopes = 0;
    float rise = (float)(rules->slope * per) / (float)book->order;
    struct odds of = {(float)per, (float)book->bits, (float)(rules->swing * per / 2), (float)odds,
                             (float)rules->log_odds};
    float *belief = detector->belief, *straight = detector->straight, *squares = detector->squares;

    believe(book->rows, detector->loud, &of, belief);
    if (damping == 0)
        believe_carried(detector, of);
    for (size_t i = 0; i < detector->unused_count; i++)
        belief[detector->unused[i]] = 0;
    list_believed(detector, damping > 0);
    for (size_t i = 0; i < next->count; i++) {
        size_t code = (size_t)next->codes[i];
        belief[i] = belief[code]; /* codes rise, so that none is overwritten before it is read */
        detector->swings[i] = belief[i] * (damping == 0 ? detector->amplitude[code] : (float)rules->swing);
        straight[i] = squares[i] = 0;
    }
    for (size_t bit = 0; bit < book->bits; bit++)
        say(next->count, next->codes, detector_sums(detector, bit), rise, detector->swings,
                   next->words + bit * book->rows, straight, squares);
    for (size_t i = 0; i < next->count; i++) {
        slopes += (double)belief[i] * (double)straight[i] * rules->slope;
        slopes += belief[i] > 0 && belief[i] < 1 ? (double)squares[i] / rules->log_odds : 0;
    }
    if (damping > 0)
        fade(detector, damping);
    exchange(detector);
    return slopes * rules->swing * per / (double)book->bits;
}

/* The words of those that are loud enough. */
static void harden(struct detector *detector, float least)
{
    const struct sparse_book *book = &detector->book;
    struct listed *next = &detector->next;

    next->count = list_above(book->rows, detector->loud, least, next->codes);
    for (size_t bit = 0; bit < book->bits; bit++)
        say_hard(next->count, next->codes, detector_sums(detector, bit), detector->loud,
                        next->words + bit * book->rows);
}

/* Power by which the next words change, per chip; INFINITY if they are not the same but for their amplitudes. */
static double change_of(const struct detector *detector)
{
    const struct listed *now = &detector->now, *next = &detector->next;
    double change = 0;

    if (now->count != next->count || memcmp(now->codes, next->codes, now->count * sizeof *now->codes) != 0)
        return INFINITY;
    for (size_t at = 0; at < detector->book.bits * detector->book.rows; at += detector->book.rows)
        change += distance(now->count, next->words + at, now->words + at);
    return change / (double)detector->book.bits;
}

/* ---- what is left -------------------------------------------------------------------------------- */

/* What words leave of the chips, without the level, which is found if it is NAN. */
static void take_off(struct detector *detector, double level, float onsager)
{
    const struct sparse_book *book = &detector->book;
    const struct listed *now = &detector->now;
    size_t chips = book->bits * book->order;
    float *told = detector->told, *spread = detector->spread;
    float known = isnan(level) ? 0 : (float)level;

    for (size_t bit = 0; bit < book->bits; bit++) {
        const float *words = now->words + bit * book->rows;
        size_t first = bit * book->order;
        for (size_t i = 0; i < now->count; i++)
            spread[now->codes[i]] = words[i];
        transform_multiply(book->walsh, spread, told, 1);
        for (size_t i = 0; i < now->count; i++)
            spread[now->codes[i]] = 0;
        take(book->order, detector->chips + first, told, book->places + first, onsager, book->flips + first,
                    known, detector->left + first);
    }
    if (isnan(level)) {
        detector->level = product(chips, detector->left, book->flips) / (double)chips;
        shift(chips, detector->left, book->flips, (float)detector->level, detector->left);
    }
}

/* Mean power of what is left. */
static double power_left(struct detector *detector)
{
    const struct sparse_book *book = &detector->book;
    double total = 0;

    for (size_t bit = 0; bit < book->bits; bit++) {
        const float *left = detector->left + bit * book->order;
        detector->power[bit] = product(book->order, left, left) / (double)book->order;
        total += detector->power[bit];
    }
    return total / (double)book->bits;
}

/* Takes off what new amplitudes explain, which are the same in all bits. */
static void reduce(struct detector *detector, double change)
{
    for (size_t bit = 0; bit < detector->book.bits; bit++)
        change = fmin(change, detector->power[bit]);
    for (size_t bit = 0; bit < detector->book.bits; bit++)
        detector->power[bit] -= change;
}

/* ---- a frame ------------------------------------------------------------------------------------- */

/* Keeps who spoke, and how loud. */
static void carry(struct detector *detector)
{
    const struct listed *next = &detector->next;
    float swing = (float)detector->rules.swing;

    detector->carried_count = next->count;
    memcpy(detector->carried, next->codes, next->count * sizeof *next->codes);
    for (size_t i = 0; i < next->count; i++) {
        float loud = detector->loud[next->codes[i]];
        detector->amplitude[next->codes[i]] = fminf(fmaxf(loud, 0.5f * swing), 1.5f * swing);
    }
}

bool detector_find(struct detector *detector, const float *chips, double damping)
{
    const struct sparse_book *book = &detector->book;
    const struct detect_rules *rules = &detector->rules;
    size_t count = book->bits * book->order;
    double before = INFINITY, swing2 = rules->swing * rules->swing, odds = 0;
    bool soft = true, were_hard = true, are_whole = true; /* of the words before */

    detector->now.count = detector->next.count = 0;
    detector->level = mean_of(chips, count);
    flip(count, chips, book->flips, detector->chips);
    shift(count, detector->chips, book->flips, (float)detector->level, detector->left);
    for (size_t turn = 0; turn < rules->turns; turn++) {
        correlate(detector);
        double power = power_left(detector), noise = power / (double)book->order;
        if (turn == 0) {
            double share = fmin(fmax(power / swing2, 1) / (double)book->nodes, 0.5);
            odds = log(share / (1 - share));
        }
        if (noise < 1e-12 * swing2) /* not fmax: a frame that is no number does not settle */
            noise = 1e-12 * swing2;
        if (noise < rules->soft_noise * rules->soft_noise * swing2 ||
            noise > rules->stalled * rules->stalled * before)
            soft = false;
        before = noise;
        bool is_last = turn + 1 == rules->turns;
        if (soft && !is_last) {
            double onsager = soften(detector, noise, odds, (float)damping);
            take_off(detector, detector->level, (float)(onsager / (double)book->order));
            are_whole = onsager == 0 && damping == 0;
        } else if (!soft) {
            harden(detector, (float)fmax(rules->least, rules->hard_share * sqrt(noise)));
            double change = change_of(detector);
            double most = fmax(rules->settled * power, rules->negligible);
            if (are_whole && (were_hard || change < rules->near * power) &&
                change * (double)detector->next.count / (double)count < most) {
                reduce(detector, change);
                carry(detector);
                return true;
            }
            if (!is_last) {
                exchange(detector);
                take_off(detector, NAN, 0);
                are_whole = true;
            }
        }
        were_hard = !soft;
    }
    detector->next.count = soft ? 0 : detector->next.count;
    return false;
}

/* Levels of the listed codes, in the places of their rows. */
static void tell(const struct detector *detector, float *rows)
{
    const struct sparse_book *book = &detector->book;
    float scale = 1.0f / (float)book->order;

    for (size_t bit = 0; bit < book->bits; bit++) {
        const float *sums = detector_sums(detector, bit);
        for (size_t row = 0; row < book->rows; row++)
            rows[bit * book->rows + row] = sums[book->codes[row]] * scale;
    }
}

void detector_detect(struct detector *detector, const float *chips, double damping, struct detected *found)
{
    const struct sparse_book *book = &detector->book;

    found->settled = detector_find(detector, chips, damping);
    found->level = detector->level;
    memcpy(found->power, detector->power, book->bits * sizeof *found->power);
    tell(detector, found->rows);
    memset(found->heard, 0, book->nodes * sizeof *found->heard);
    for (size_t i = 0; i < detector->next.count; i++)
        found->heard[detector->nodes[detector->next.codes[i]]] = true;
    flip(book->bits * book->order, detector->left, book->flips, found->left);
}

void detector_loudness(struct detector *detector, const float *chips, ptrdiff_t lateness, float *loudness)
{
    const struct sparse_book *book = &detector->book;
    ptrdiff_t order = (ptrdiff_t)book->order;
    ptrdiff_t first = lateness < 0 ? -lateness : 0, end = lateness > 0 ? order - lateness : order;

    detector->now.count = 0;
    for (size_t bit = 0; bit < book->bits; bit++)
        for (ptrdiff_t i = 0; i < order; i++) {
            size_t at = bit * book->order + (size_t)i;
            bool is_read = first <= i && i < end;
            detector->left[at] = is_read ? chips[(ptrdiff_t)at + lateness] * book->flips[at] : 0.0f;
        }
    correlate(detector);
    for (size_t node = 0; node < book->nodes; node++)
        loudness[node] = detector->loud[book->codes[node + 1]];
}
