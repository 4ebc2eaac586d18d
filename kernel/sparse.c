// SPDX-License-Identifier: Apache-2.0

#include "sparse.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "vectors.h"
#include "words.h"

#define LANES 8 /* sums that are kept apart, so that they can be added at once */
#define APART_BY 16 /* floats between the levels of bits: else all of a code are in one place of the cache */

/* Codes, rising, and their words: those of a bit from (bit · rows) on, in the same order. */
struct listed {
    size_t count;
    int32_t *codes;
    float *words;
};

struct sparse {
    struct sparse_book book;
    struct sparse_rules rules;
    float *chips;           /* (k, N), flipped back, as is `left` */
    float *left;            /* what words leave over of them */
    float *sums;            /* (k, 2^m + APART_BY) levels of all codes, times the chips per bit */
    float *told;            /* (2^m) the chips of a bit's words, wherever a chip may be */
    float *spread;          /* (2^m) 0, but for a bit's chips or words while they are transformed */
    float *loud, *belief;   /* (2^m): mean |r|; share of a word that is believed */
    float *straight, *squares; /* (2^m) of those that are listed: see soften; squares of a frame's levels */
    float *amplitude;       /* (2^m) of a node, V: when it last spoke, in a frame that settled */
    float *swings;          /* (2^m) of those that are listed: as that, or what every node has */
    float *alike;           /* (k, 2^m) products of codes, at the XOR of these; NULL in long books */
    double *triangle;       /* (most that are told apart)² */
    int32_t *unused;        /* codes of no node */
    int32_t *carried;       /* those that spoke in the last frame that settled */
    int32_t *from;          /* where a listed one was listed before, or -1 */
    int32_t *nodes;         /* (2^m) node of every code, from 0 on; -1: none */
    size_t unused_count, carried_count;
    struct listed now, next; /* words that are taken off; those that will be */
    double power[WORDS_MOST_BITS];
    double level;
};

static bool make_list(struct listed *list, const struct sparse_book *book)
{
    list->codes = malloc(book->rows * sizeof *list->codes);
    list->words = malloc(book->bits * book->rows * sizeof *list->words);
    return list->codes && list->words;
}

/* Products of codes i and j of a bit are one at i XOR j: the sum of the signs of this code's chips. */
static bool make_products(struct sparse *sparse)
{
    const struct sparse_book *book = &sparse->book;
    size_t most = sparse->rules.capacity;

    sparse->alike = calloc(book->bits * book->rows, sizeof *sparse->alike);
    sparse->triangle = malloc(most * most * sizeof *sparse->triangle);
    if (!(sparse->alike && sparse->triangle))
        return false;
    for (size_t bit = 0; bit < book->bits; bit++)
        for (size_t i = 0; i < book->order; i++)
            sparse->alike[bit * book->rows + (size_t)book->places[bit * book->order + i]] = 1.0f / (float)book->order;
    transform_multiply(book->walsh, sparse->alike, sparse->alike, book->bits);
    return true;
}

struct sparse *sparse_new(const struct sparse_book *book, const struct sparse_rules *rules)
{
    size_t chips = book->bits * book->order, levels = book->bits * (book->rows + APART_BY);
    struct sparse *sparse = calloc(1, sizeof *sparse);

    if (!sparse)
        return NULL;
    sparse->book = *book;
    sparse->rules = *rules;
    sparse->chips = calloc(2 * chips + levels + 8 * book->rows, sizeof(float));
    sparse->unused = malloc(4 * book->rows * sizeof(int32_t));
    if (!(sparse->chips && sparse->unused && make_list(&sparse->now, book) && make_list(&sparse->next, book))) {
        sparse_free(sparse);
        return NULL;
    }
    sparse->left = sparse->chips + chips;
    sparse->sums = sparse->left + chips;
    sparse->told = sparse->sums + levels;
    sparse->loud = sparse->told + book->rows;
    sparse->belief = sparse->loud + book->rows;
    sparse->straight = sparse->belief + book->rows;
    sparse->squares = sparse->straight + book->rows;
    sparse->amplitude = sparse->squares + book->rows;
    sparse->swings = sparse->amplitude + book->rows;
    sparse->spread = sparse->swings + book->rows;
    sparse->carried = sparse->unused + book->rows;
    sparse->from = sparse->carried + book->rows;
    sparse->nodes = sparse->from + book->rows;
    if (rules->alike && !make_products(sparse)) {
        sparse_free(sparse);
        return NULL;
    }
    for (size_t row = 0; row < book->rows; row++) {
        bool is_node = row > 0 && row <= book->nodes;
        sparse->amplitude[row] = (float)rules->swing;
        sparse->nodes[book->codes[row]] = is_node ? (int32_t)row - 1 : -1;
        if (!is_node)
            sparse->unused[sparse->unused_count++] = book->codes[row];
    }
    return sparse;
}

void sparse_free(struct sparse *sparse)
{
    if (!sparse)
        return;
    free(sparse->chips);
    free(sparse->unused);
    free(sparse->alike);
    free(sparse->triangle);
    free(sparse->now.codes);
    free(sparse->now.words);
    free(sparse->next.codes);
    free(sparse->next.words);
    free(sparse);
}

const struct sparse_book *sparse_book(const struct sparse *sparse)
{
    return &sparse->book;
}

static float *sums_of(const struct sparse *sparse, size_t bit)
{
    return sparse->sums + bit * (sparse->book.rows + APART_BY);
}

/* ---- passes over all rows or chips --------------------------------------------------------------- */

/* Means over the bits, scaled; sums: so many values from bit to bit. */
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

VECTORS static void add_squares(size_t rows, const float *restrict sums, float *restrict squares)
{
    for (size_t i = 0; i < rows; i++)
        squares[i] += sums[i] * sums[i];
}

VECTORS static bool any_above(size_t rows, const float *values, float most)
{
    int any = 0;

    for (size_t i = 0; i < rows; i++)
        any |= values[i] > most;
    return any;
}

VECTORS static void flip(size_t count, const float *restrict chips, const float *restrict flips,
                         float *restrict flipped)
{
    for (size_t i = 0; i < count; i++)
        flipped[i] = chips[i] * flips[i];
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

/* Levels of all codes in what is left of the chips, with the words that were taken off; and how loud each is. Bit by
 * bit, because all of one fits the nearest cache. */
static void correlate(struct sparse *sparse)
{
    const struct sparse_book *book = &sparse->book;
    const struct listed *now = &sparse->now;
    const int32_t *places = book->places;
    const float *left = sparse->left;
    float *loud = sparse->loud, *spread = sparse->spread, order = (float)book->order;

    for (size_t bit = 0; bit < book->bits; bit++, left += book->order, places += book->order) {
        const float *words = now->words + bit * book->rows;
        float *sums = sums_of(sparse, bit);
        for (size_t i = 0; i < book->order; i++)
            spread[places[i]] = left[i];
        transform_multiply(book->walsh, spread, sums, 1);
        memset(spread, 0, book->rows * sizeof *spread);
        for (size_t i = 0; i < now->count; i++)
            sums[now->codes[i]] += order * words[i];
    }
    average_loud(book->rows, book->bits, book->rows + APART_BY, sparse->sums, 1.0f / (order * (float)book->bits), loud);
    for (size_t i = 0; i < sparse->unused_count; i++)
        loud[sparse->unused[i]] = 0;
}

INLINE float share_of(float loud, float per, float bits, float half, float odds, float span)
{
    const float turn = 2 * 0.69314718f;
    float u = per * loud;
    float log_cosh = u < turn ? u * u / (2 * turn) : u - turn / 2;
    float share = 0.5f + (bits * (log_cosh - half) + odds) / span;

    return share < 0 ? 0 : share > 1 ? 1 : share;
}

VECTORS static void believe(size_t rows, const float *restrict loud, float *restrict belief, float per,
                            float bits, float half, float odds, float span)
{
    for (size_t i = 0; i < rows; i++)
        belief[i] = share_of(loud[i], per, bits, half, odds, span);
}

/* ---- words ------------------------------------------------------------------------------------- */

static void exchange(struct sparse *sparse)
{
    struct listed now = sparse->now;

    sparse->now = sparse->next;
    sparse->next = now;
}

/* Lists the codes that have more: most eights of codes have none, and in others it is a guess who has. */
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

/* Lists those who are believed, and those who were listed, if what they said is kept. */
static void list_believed(struct sparse *sparse, bool keeps)
{
    const struct listed *now = &sparse->now;
    struct listed *next = &sparse->next;
    size_t old = 0;

    if (!keeps) {
        next->count = list_above(sparse->book.rows, sparse->belief, 0, next->codes);
        return;
    }
    next->count = 0;
    for (size_t code = 0; code < sparse->book.rows; code++) {
        bool was = old < now->count && (size_t)now->codes[old] == code;
        if (sparse->belief[code] > 0 || was) {
            sparse->from[next->count] = was ? (int32_t)old : -1;
            next->codes[next->count++] = (int32_t)code;
        }
        old += was;
    }
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

/* Words keep a share of what they were. */
static void fade(const struct sparse *sparse, float damping)
{
    const struct listed *now = &sparse->now, *next = &sparse->next;

    for (size_t bit = 0; bit < sparse->book.bits; bit++) {
        const float *before = now->words + bit * sparse->book.rows;
        float *words = next->words + bit * sparse->book.rows;
        for (size_t i = 0; i < next->count; i++)
            words[i] += damping * ((sparse->from[i] < 0 ? 0 : before[sparse->from[i]]) - words[i]);
    }
}

/* Those who spoke in the frame before do as likely as not, whatever others do. */
static void believe_carried(struct sparse *sparse, float per, float half)
{
    for (size_t i = 0; i < sparse->carried_count; i++) {
        size_t code = (size_t)sparse->carried[i];
        float share = share_of(sparse->loud[code], per, (float)sparse->book.bits, half, 0,
                               (float)sparse->rules.log_odds);
        sparse->belief[code] = fmaxf(sparse->belief[code], share);
    }
}

/* As _soft_words; returns the mean sum of derivatives. damping: also says that what earlier frames told is not used. */
static double soften(struct sparse *sparse, double noise, double odds, float damping)
{
    const struct sparse_book *book = &sparse->book;
    const struct sparse_rules *rules = &sparse->rules;
    struct listed *next = &sparse->next;
    double per = rules->swing / noise, slopes = 0;
    float rise = (float)(rules->slope * per) / (float)book->order, half = (float)(rules->swing * per / 2);
    float *belief = sparse->belief, *straight = sparse->straight, *squares = sparse->squares;

    believe(book->rows, sparse->loud, belief, (float)per, (float)book->bits, half, (float)odds,
            (float)rules->log_odds);
    if (damping == 0)
        believe_carried(sparse, (float)per, half);
    for (size_t i = 0; i < sparse->unused_count; i++)
        belief[sparse->unused[i]] = 0;
    list_believed(sparse, damping > 0);
    for (size_t i = 0; i < next->count; i++) {
        size_t code = (size_t)next->codes[i];
        belief[i] = belief[code]; /* codes rise, so that none is overwritten before it is read */
        sparse->swings[i] = belief[i] * (damping == 0 ? sparse->amplitude[code] : (float)rules->swing);
        straight[i] = squares[i] = 0;
    }
    for (size_t bit = 0; bit < book->bits; bit++)
        say(next->count, next->codes, sums_of(sparse, bit), rise, sparse->swings,
            next->words + bit * book->rows, straight, squares);
    for (size_t i = 0; i < next->count; i++) {
        slopes += (double)belief[i] * (double)straight[i] * rules->slope;
        slopes += belief[i] > 0 && belief[i] < 1 ? (double)squares[i] / rules->log_odds : 0;
    }
    if (damping > 0)
        fade(sparse, damping);
    exchange(sparse);
    return slopes * rules->swing * per / (double)book->bits;
}

/* The hard words of one bit. */
VECTORS static void say_hard(size_t count, const int32_t *restrict codes, const float *restrict sums,
                             const float *restrict loud, float *restrict words)
{
    for (size_t i = 0; i < count; i++)
        words[i] = copysignf(loud[codes[i]], sums[codes[i]]);
}

/* The words of those that are loud enough. */
static void harden(struct sparse *sparse, float least)
{
    const struct sparse_book *book = &sparse->book;
    struct listed *next = &sparse->next;

    next->count = list_above(book->rows, sparse->loud, least, next->codes);
    for (size_t bit = 0; bit < book->bits; bit++)
        say_hard(next->count, next->codes, sums_of(sparse, bit), sparse->loud, next->words + bit * book->rows);
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

/* Power by which the next words change, per chip; INFINITY if they are not the same but for their amplitudes. */
static double change_of(const struct sparse *sparse)
{
    const struct listed *now = &sparse->now, *next = &sparse->next;
    double change = 0;

    if (now->count != next->count || memcmp(now->codes, next->codes, now->count * sizeof *now->codes) != 0)
        return INFINITY;
    for (size_t at = 0; at < sparse->book.bits * sparse->book.rows; at += sparse->book.rows)
        change += distance(now->count, next->words + at, now->words + at);
    return change / (double)sparse->book.bits;
}

VECTORS static void take(size_t count, const float *restrict chips, const float *restrict told,
                         const int32_t *restrict places, float onsager, const float *restrict flips, float level,
                         float *restrict left)
{
    for (size_t i = 0; i < count; i++)
        left[i] = chips[i] - told[places[i]] + onsager * left[i] - level * flips[i];
}

/* Chips, which may be `left`, without the level. */
VECTORS static void shift(size_t count, const float *chips, const float *restrict flips, float level, float *left)
{
    APART
    for (size_t i = 0; i < count; i++)
        left[i] = chips[i] - level * flips[i];
}

/* What words leave of the chips, without the level, which is found if it is NAN. */
static void take_off(struct sparse *sparse, double level, float onsager)
{
    const struct sparse_book *book = &sparse->book;
    const struct listed *now = &sparse->now;
    size_t chips = book->bits * book->order;
    float *told = sparse->told, *spread = sparse->spread;
    float known = isnan(level) ? 0 : (float)level;

    for (size_t bit = 0; bit < book->bits; bit++) {
        const float *words = now->words + bit * book->rows;
        size_t first = bit * book->order;
        for (size_t i = 0; i < now->count; i++)
            spread[now->codes[i]] = words[i];
        transform_multiply(book->walsh, spread, told, 1);
        for (size_t i = 0; i < now->count; i++)
            spread[now->codes[i]] = 0;
        take(book->order, sparse->chips + first, told, book->places + first, onsager, book->flips + first, known,
             sparse->left + first);
    }
    if (isnan(level)) {
        sparse->level = product(chips, sparse->left, book->flips) / (double)chips;
        shift(chips, sparse->left, book->flips, (float)sparse->level, sparse->left);
    }
}

/* ---- a frame ----------------------------------------------------------------------------------- */

/* Mean power of what is left. */
static double power_left(struct sparse *sparse)
{
    const struct sparse_book *book = &sparse->book;
    double total = 0;

    for (size_t bit = 0; bit < book->bits; bit++) {
        const float *left = sparse->left + bit * book->order;
        sparse->power[bit] = product(book->order, left, left) / (double)book->order;
        total += sparse->power[bit];
    }
    return total / (double)book->bits;
}

/* Takes off what new amplitudes explain, which are the same in all bits. */
static void reduce(struct sparse *sparse, double change)
{
    for (size_t bit = 0; bit < sparse->book.bits; bit++)
        change = fmin(change, sparse->power[bit]);
    for (size_t bit = 0; bit < sparse->book.bits; bit++)
        sparse->power[bit] -= change;
}

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

/* Keeps who spoke, and how loud. */
static void carry(struct sparse *sparse)
{
    const struct listed *next = &sparse->next;
    float swing = (float)sparse->rules.swing;

    sparse->carried_count = next->count;
    memcpy(sparse->carried, next->codes, next->count * sizeof *next->codes);
    for (size_t i = 0; i < next->count; i++) {
        float loud = sparse->loud[next->codes[i]];
        sparse->amplitude[next->codes[i]] = fminf(fmaxf(loud, 0.5f * swing), 1.5f * swing);
    }
}

/* Finds words, which are in `next` afterwards; whether they stayed the same in the end. */
static bool detect(struct sparse *sparse, const float *chips, double damping)
{
    const struct sparse_book *book = &sparse->book;
    const struct sparse_rules *rules = &sparse->rules;
    size_t count = book->bits * book->order;
    double before = INFINITY, swing2 = rules->swing * rules->swing, odds = 0;
    bool soft = true, were_hard = true, are_whole = true; /* of the words before */

    sparse->now.count = sparse->next.count = 0;
    sparse->level = mean_of(chips, count);
    flip(count, chips, book->flips, sparse->chips);
    shift(count, sparse->chips, book->flips, (float)sparse->level, sparse->left);
    for (size_t turn = 0; turn < rules->turns; turn++) {
        correlate(sparse);
        double power = power_left(sparse), noise = power / (double)book->order;
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
            double onsager = soften(sparse, noise, odds, (float)damping);
            take_off(sparse, sparse->level, (float)(onsager / (double)book->order));
            are_whole = onsager == 0 && damping == 0;
        } else if (!soft) {
            harden(sparse, (float)fmax(rules->least, rules->hard_share * sqrt(noise)));
            double change = change_of(sparse);
            double most = fmax(rules->settled * power, rules->negligible);
            if (are_whole && (were_hard || change < rules->near * power) &&
                change * (double)sparse->next.count / (double)count < most) {
                reduce(sparse, change);
                carry(sparse);
                return true;
            }
            if (!is_last) {
                exchange(sparse);
                take_off(sparse, NAN, 0);
                are_whole = true;
            }
        }
        were_hard = !soft;
    }
    sparse->next.count = soft ? 0 : sparse->next.count;
    return false;
}

/* Levels of the listed codes, in the places of their rows. */
static void tell(const struct sparse *sparse, float *rows)
{
    const struct sparse_book *book = &sparse->book;
    float scale = 1.0f / (float)book->order;

    for (size_t bit = 0; bit < book->bits; bit++) {
        const float *sums = sums_of(sparse, bit);
        for (size_t row = 0; row < book->rows; row++)
            rows[bit * book->rows + row] = sums[book->codes[row]] * scale;
    }
}

void sparse_detect(struct sparse *sparse, const float *chips, double damping, struct sparse_found *found)
{
    const struct sparse_book *book = &sparse->book;

    found->settled = detect(sparse, chips, damping);
    found->level = sparse->level;
    memcpy(found->power, sparse->power, book->bits * sizeof *found->power);
    tell(sparse, found->rows);
    memset(found->heard, 0, book->nodes * sizeof *found->heard);
    for (size_t i = 0; i < sparse->next.count; i++)
        found->heard[sparse->nodes[sparse->next.codes[i]]] = true;
    flip(book->bits * book->order, sparse->left, book->flips, found->left);
}

/* ---- the certificate ------------------------------------------------------------------------------ */

/* Mean square of the noise of chips, of so much power that is left: words have taken their share of it. */
static double noise_of(const struct sparse *sparse, double power)
{
    double chips = (double)(sparse->book.bits * sparse->book.order);
    double left = chips - (double)sparse->next.count - 1;

    return power * (chips / (left < 1 ? 1 : left));
}

/* As SparseRecogniser._are_told_apart: by the pivots of Cholesky's decomposition. */
static bool are_told_apart(const struct sparse *sparse, double noise)
{
    const struct sparse_rules *rules = &sparse->rules;
    size_t count = sparse->next.count;
    double least = (rules->more + rules->chance_of_bit * noise / (rules->swing * rules->swing)) / 8;
    double *row = sparse->triangle;

    for (size_t bit = 0; sparse->alike && bit < sparse->book.bits; bit++) {
        const float *alike = sparse->alike + bit * sparse->book.rows;
        for (size_t i = 0; i < count; i++)
            for (size_t j = 0; j <= i; j++) {
                double sum = (double)alike[sparse->next.codes[i] ^ sparse->next.codes[j]] - (i == j ? least : 0);
                for (size_t l = 0; l < j; l++)
                    sum -= row[i * count + l] * row[j * count + l];
                if (i == j && !(sum > 0))
                    return false;
                row[i * count + j] = i == j ? sqrt(sum) : sum / row[j * count + j];
            }
    }
    return true;
}

/* Whether the words leave no more than noise, in any bit, and no others would leave nearly as little. */
static bool words_explain(const struct sparse *sparse, double noise)
{
    const struct sparse_rules *rules = &sparse->rules;
    double swing2 = rules->swing * rules->swing, mean = 0, most = 0, power = 0;
    double more = (rules->more + rules->tolerance * rules->tolerance * (double)sparse->next.count) * swing2;

    for (size_t bit = 0; bit < sparse->book.bits; bit++) {
        mean += noise_of(sparse, sparse->power[bit]) / (double)sparse->book.bits;
        most = fmax(most, noise_of(sparse, sparse->power[bit]));
        power += sparse->power[bit] / (double)sparse->book.bits;
    }
    return sparse->next.count <= rules->capacity && power < rules->most_noise && mean < noise * (1 + rules->chance) + more &&
           most < noise * (1 + rules->chance_of_bit) + more && are_told_apart(sparse, noise);
}

/* Whether the row of anyone who did not speak holds more than noise; see rises in amplitude.py. noise: V², of a level. */
static bool silence_rises(struct sparse *sparse, double noise)
{
    const struct sparse_book *book = &sparse->book;
    float *squares = sparse->squares, *loud = sparse->loud, order2 = (float)book->order * (float)book->order;
    float most = fmaxf((float)sparse->rules.silent_square, (float)(sparse->rules.silent_power * noise));

    for (size_t i = 0; i < sparse->next.count; i++)
        loud[sparse->next.codes[i]] = 0;
    /* The sum of squares is no more than the square of the sum; but for rounding. */
    float least = 0.999f * sqrtf(most) / (float)book->bits;
    if (!any_above(book->rows, loud, least))
        return false;
    memset(squares, 0, book->rows * sizeof *squares);
    for (size_t bit = 0; bit < book->bits; bit++)
        add_squares(book->rows, sums_of(sparse, bit), squares);
    for (size_t i = 0; i < sparse->unused_count; i++)
        squares[sparse->unused[i]] = 0;
    for (size_t i = 0; i < sparse->next.count; i++)
        squares[sparse->next.codes[i]] = 0;
    return any_above(book->rows, squares, most * order2);
}

void sparse_learn(const struct sparse *sparse, double found, double *noise)
{
    *noise = *noise > 0 ? *noise + sparse->rules.weight * (found - *noise) : found;
}

/* Levels of those who spoke. */
static void tell_spoken(const struct sparse *sparse, float *levels, int32_t *spoke)
{
    const struct sparse_book *book = &sparse->book;
    const struct listed *next = &sparse->next;

    for (size_t i = 0; i < next->count; i++)
        spoke[i] = sparse->nodes[next->codes[i]];
    for (size_t bit = 0; bit < book->bits; bit++) {
        const float *sums = sums_of(sparse, bit);
        for (size_t i = 0; i < next->count; i++)
            *levels++ = sums[next->codes[i]] * (1.0f / (float)book->order);
    }
}

bool sparse_read(struct sparse *sparse, const float *chips, double *noise, float *levels, int32_t *spoke,
                 struct sparse_told *told)
{
    const struct sparse_book *book = &sparse->book;
    const struct sparse_rules *rules = &sparse->rules;
    double swing2 = rules->swing * rules->swing, found = 0;

    if (!(*noise > 0 && rules->chance * *noise <= rules->hiding * swing2) || !detect(sparse, chips, 0))
        return false;
    for (size_t bit = 0; bit < book->bits; bit++)
        found += noise_of(sparse, sparse->power[bit]);
    found /= (double)book->bits;
    if (!words_explain(sparse, *noise) || silence_rises(sparse, found / (double)book->order))
        return false;
    tell_spoken(sparse, levels, spoke);
    *told = (struct sparse_told){sparse->level, sqrt(found / (double)book->order), sparse->next.count};
    sparse_learn(sparse, found, noise);
    return true;
}

void sparse_loudness(struct sparse *sparse, const float *chips, ptrdiff_t lateness, float *loudness)
{
    const struct sparse_book *book = &sparse->book;
    ptrdiff_t order = (ptrdiff_t)book->order;
    ptrdiff_t first = lateness < 0 ? -lateness : 0, end = lateness > 0 ? order - lateness : order;

    sparse->now.count = 0;
    for (size_t bit = 0; bit < book->bits; bit++)
        for (ptrdiff_t i = 0; i < order; i++) {
            size_t at = bit * book->order + (size_t)i;
            bool is_read = first <= i && i < end;
            sparse->left[at] = is_read ? chips[(ptrdiff_t)at + lateness] * book->flips[at] : 0.0f;
        }
    correlate(sparse);
    for (size_t node = 0; node < book->nodes; node++)
        loudness[node] = sparse->loud[book->codes[node + 1]];
}
