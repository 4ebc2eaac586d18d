// SPDX-License-Identifier: Apache-2.0

#include "sparse.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "vectors.h"

struct sparse {
    struct sparse_book book;
    struct sparse_rules rules;
    float *chips;           /* (k, N), flipped back, as is `left` */
    float *left;            /* what words leave over of them */
    float *sums, *words;    /* (k, 2^m); words are 0 but for those that are listed */
    float *loud, *belief;   /* (2^m): mean |r|; share of a word that is believed, or whether it is taken off */
    int32_t *unused;        /* codes of no node */
    int32_t *listed;        /* codes with words; is_listed: the same by code */
    size_t unused_count, listed_count;
    uint8_t *is_listed;
};

struct sparse *sparse_new(const struct sparse_book *book, const struct sparse_rules *rules)
{
    size_t chips = book->bits * book->order, levels = book->bits * book->rows;
    struct sparse *sparse = calloc(1, sizeof *sparse);

    if (!sparse)
        return NULL;
    sparse->book = *book;
    sparse->rules = *rules;
    sparse->chips = calloc(2 * chips + 2 * levels + 2 * book->rows, sizeof(float));
    sparse->listed = malloc(2 * book->rows * sizeof(int32_t));
    sparse->is_listed = calloc(book->rows, 1);
    if (!sparse->chips || !sparse->listed || !sparse->is_listed) {
        sparse_free(sparse);
        return NULL;
    }
    sparse->left = sparse->chips + chips;
    sparse->sums = sparse->left + chips;
    sparse->words = sparse->sums + levels;
    sparse->loud = sparse->words + levels;
    sparse->belief = sparse->loud + book->rows;
    sparse->unused = sparse->listed + book->rows;
    for (size_t row = 0; row < book->rows; row++)
        if (row == 0 || row > book->nodes)
            sparse->unused[sparse->unused_count++] = book->codes[row];
    return sparse;
}

void sparse_free(struct sparse *sparse)
{
    if (!sparse)
        return;
    free(sparse->chips);
    free(sparse->listed);
    free(sparse->is_listed);
    free(sparse);
}

/* ---- passes over all rows ---------------------------------------------------------------------- */

VECTORS static void scale_and_add(size_t rows, float scale, float *restrict sums,
                                  const float *restrict words, float *restrict loud)
{
    for (size_t i = 0; i < rows; i++) {
        sums[i] = sums[i] * scale + words[i];
        loud[i] += fabsf(sums[i]);
    }
}

VECTORS static void gather(size_t count, const float *restrict from, const int32_t *restrict at,
                           float *restrict to)
{
    for (size_t i = 0; i < count; i++)
        to[i] = from[at[i]];
}

/* Rows of chips, with the words that were taken off them; and how loud each is. Bit by bit, because all of one fits
 * the nearest cache. */
static void correlate(struct sparse *sparse, const float *chips)
{
    const struct sparse_book *book = &sparse->book;
    const int32_t *places = book->places;
    float *loud = sparse->loud;

    memset(loud, 0, book->rows * sizeof *loud);
    for (size_t bit = 0; bit < book->bits; bit++, chips += book->order, places += book->order) {
        float *sums = sparse->sums + bit * book->rows;
        memset(sums, 0, book->rows * sizeof *sums);
        for (size_t i = 0; i < book->order; i++)
            sums[places[i]] = chips[i];
        transform_multiply(book->walsh, sums, sums, 1);
        scale_and_add(book->rows, 1.0f / (float)book->order, sums, sparse->words + bit * book->rows, loud);
    }
    for (size_t i = 0; i < book->rows; i++)
        loud[i] *= 1.0f / (float)book->bits;
    for (size_t i = 0; i < sparse->unused_count; i++)
        loud[sparse->unused[i]] = 0;
}

VECTORS static void believe(size_t rows, const float *restrict loud, float *restrict belief, float per,
                            float bits, float half, float odds, float span)
{
    const float turn = 2 * 0.69314718f;

    for (size_t i = 0; i < rows; i++) {
        float u = per * loud[i];
        float log_cosh = u < turn ? u * u / (2 * turn) : u - turn / 2;
        float share = 0.5f + (bits * (log_cosh - half) + odds) / span;
        belief[i] = share < 0 ? 0 : share > 1 ? 1 : share;
    }
}

/* ---- words ------------------------------------------------------------------------------------- */

static void list(struct sparse *sparse, size_t code)
{
    if (!sparse->is_listed[code])
        sparse->listed[sparse->listed_count++] = (int32_t)code;
    sparse->is_listed[code] = 1;
}

/* Keeps a share of all words. */
static void fade(struct sparse *sparse, float share)
{
    const struct sparse_book *book = &sparse->book;

    for (size_t i = 0; i < sparse->listed_count; i++) {
        size_t code = (size_t)sparse->listed[i];
        for (size_t bit = 0; bit < book->bits; bit++)
            sparse->words[bit * book->rows + code] *= share;
        sparse->is_listed[code] = share != 0;
    }
    if (share == 0)
        sparse->listed_count = 0;
}

/* As _soft_words; returns the mean sum of derivatives. */
static double soften(struct sparse *sparse, double noise, double odds, float damping)
{
    const struct sparse_book *book = &sparse->book;
    const struct sparse_rules *rules = &sparse->rules;
    double per = rules->swing / noise, slopes = 0;
    float rise = (float)(rules->slope * per), swing = (float)rules->swing;

    believe(book->rows, sparse->loud, sparse->belief, (float)per, (float)book->bits,
            (float)(rules->swing * per / 2), (float)odds, (float)rules->log_odds);
    for (size_t i = 0; i < sparse->unused_count; i++)
        sparse->belief[sparse->unused[i]] = 0;
    fade(sparse, damping);
    for (size_t code = 0; code < book->rows; code++) {
        float belief = sparse->belief[code], squares = 0;
        if (belief <= 0)
            continue;
        size_t straight = 0;
        list(sparse, code);
        for (size_t bit = 0; bit < book->bits; bit++) {
            size_t at = bit * book->rows + code;
            float said = rise * sparse->sums[at];
            said = said < -1 ? -1 : said > 1 ? 1 : said;
            straight += fabsf(said) < 1;
            squares += said * said;
            sparse->words[at] += (1 - damping) * swing * belief * said;
        }
        slopes += (double)belief * (double)straight * rules->slope;
        slopes += belief < 1 ? (double)squares / rules->log_odds : 0;
    }
    return slopes * rules->swing * per / (double)book->bits;
}

/* Power by which words that are loud enough would change, per chip; how many these are, and whether they are the
 * same but for their amplitudes. */
static double change_of(const struct sparse *sparse, float least, size_t *count, bool *same)
{
    const struct sparse_book *book = &sparse->book;
    double change = 0;

    *count = 0;
    *same = true;

    for (size_t code = 0; code < book->rows; code++) {
        float loud = sparse->loud[code];
        if (!(loud > least || sparse->is_listed[code]))
            continue;
        *count += loud > least;
        for (size_t bit = 0; bit < book->bits; bit++) {
            size_t at = bit * book->rows + code;
            float newer = loud > least ? copysignf(loud, sparse->sums[at]) : 0.0f;
            *same = *same && newer * sparse->words[at] > 0;
            change += (double)(newer - sparse->words[at]) * (double)(newer - sparse->words[at]);
        }
    }
    return change / (double)book->bits;
}

static void harden(struct sparse *sparse, float least)
{
    const struct sparse_book *book = &sparse->book;

    fade(sparse, 0);
    for (size_t code = 0; code < book->rows; code++) {
        if (!(sparse->loud[code] > least))
            continue;
        list(sparse, code);
        for (size_t bit = 0; bit < book->bits; bit++) {
            size_t at = bit * book->rows + code;
            sparse->words[at] = copysignf(sparse->loud[code], sparse->sums[at]);
        }
    }
}

VECTORS static void take(size_t count, const float *restrict chips, const float *restrict told,
                         const int32_t *restrict places, float onsager, float *restrict left)
{
    for (size_t i = 0; i < count; i++)
        left[i] = chips[i] - told[places[i]] + onsager * left[i];
}

/* What words leave of the chips, but for the level, which is known, or NAN; returns it. */
static double take_off(struct sparse *sparse, double level, float onsager)
{
    const struct sparse_book *book = &sparse->book;
    size_t chips = book->bits * book->order;
    float *told = sparse->sums, *left = sparse->left;

    for (size_t bit = 0; bit < book->bits; bit++) {
        size_t first = bit * book->order;
        transform_multiply(book->walsh, sparse->words + bit * book->rows, told, 1);
        take(book->order, sparse->chips + first, told, book->places + first, onsager, left + first);
    }
    if (isnan(level)) {
        double sums[4] = {0};
        for (size_t i = 0; i < chips; i++)
            sums[i & 3] += (double)(left[i] * book->flips[i]);
        level = (sums[0] + sums[1] + sums[2] + sums[3]) / (double)chips;
    }
    for (size_t i = 0; i < chips; i++)
        left[i] -= (float)level * book->flips[i];
    return level;
}

/* ---- a frame ----------------------------------------------------------------------------------- */

static double power_of(const struct sparse *sparse, double *power)
{
    const struct sparse_book *book = &sparse->book;
    double total = 0;

    for (size_t bit = 0; bit < book->bits; bit++) {
        const float *left = sparse->left + bit * book->order;
        double sums[4] = {0};
        for (size_t i = 0; i < book->order; i++)
            sums[i & 3] += (double)left[i] * (double)left[i];
        power[bit] = (sums[0] + sums[1] + sums[2] + sums[3]) / (double)book->order;
        total += power[bit];
    }
    return total / (double)book->bits;
}

/* Takes off what new amplitudes explain, which are the same in all bits. */
static void reduce(size_t bits, double *power, double change)
{
    for (size_t bit = 0; bit < bits; bit++)
        change = fmin(change, power[bit]);
    for (size_t bit = 0; bit < bits; bit++)
        power[bit] -= change;
}

void sparse_detect(struct sparse *sparse, const float *chips, double damping, struct sparse_found *found)
{
    const struct sparse_book *book = &sparse->book;
    const struct sparse_rules *rules = &sparse->rules;
    size_t count = book->bits * book->order;
    double level = 0, before = INFINITY, swing2 = rules->swing * rules->swing, odds = 0;
    bool soft = true, were_hard = true;

    fade(sparse, 0);
    for (size_t i = 0; i < count; i++)
        level += (double)chips[i];
    level /= (double)count;
    for (size_t i = 0; i < count; i++) {
        sparse->chips[i] = chips[i] * book->flips[i];
        sparse->left[i] = (chips[i] - (float)level) * book->flips[i];
    }
    found->settled = false;
    float least = INFINITY;
    for (size_t turn = 0; turn < rules->turns; turn++) {
        correlate(sparse, sparse->left);
        double power = power_of(sparse, found->power), noise = power / (double)book->order;
        if (turn == 0) {
            double share = fmin(fmax(power / swing2, 1) / (double)book->nodes, 0.5);
            odds = log(share / (1 - share));
        }
        noise = fmax(noise, 1e-12 * swing2);
        if (noise < rules->soft_noise * rules->soft_noise * swing2 ||
            noise > rules->stalled * rules->stalled * before)
            soft = false;
        before = noise;
        if (!soft) {
            least = (float)fmax(rules->least, rules->hard_share * sqrt(noise));
            size_t words;
            bool same;
            double change = change_of(sparse, least, &words, &same);
            double most = fmax(rules->settled * power, rules->negligible);
            found->settled = same && were_hard && change * (double)words / (double)count < most;
            if (found->settled)
                reduce(book->bits, found->power, change);
        }
        were_hard = !soft;
        if (found->settled || turn + 1 == rules->turns)
            break;
        if (soft) {
            double onsager = soften(sparse, noise, odds, (float)damping);
            take_off(sparse, level, (float)(onsager / (double)book->order));
        } else {
            harden(sparse, least);
            level = take_off(sparse, NAN, 0);
        }
    }
    found->level = level;
    for (size_t bit = 0; bit < book->bits; bit++)
        gather(book->rows, sparse->sums + bit * book->rows, book->codes, found->rows + bit * book->rows);
    for (size_t node = 0; node < book->nodes; node++)
        found->heard[node] = sparse->loud[book->codes[node + 1]] > least;
    for (size_t i = 0; i < count; i++)
        found->left[i] = sparse->left[i] * book->flips[i];
}

void sparse_loudness(struct sparse *sparse, const float *chips, ptrdiff_t lateness, float *loudness)
{
    const struct sparse_book *book = &sparse->book;
    ptrdiff_t order = (ptrdiff_t)book->order;
    ptrdiff_t first = lateness < 0 ? -lateness : 0, end = lateness > 0 ? order - lateness : order;

    fade(sparse, 0);
    for (size_t bit = 0; bit < book->bits; bit++)
        for (ptrdiff_t i = 0; i < order; i++) {
            size_t at = bit * book->order + (size_t)i;
            bool is_read = first <= i && i < end;
            sparse->left[at] = is_read ? chips[(ptrdiff_t)at + lateness] * book->flips[at] : 0.0f;
        }
    correlate(sparse, sparse->left);
    for (size_t node = 0; node < book->nodes; node++)
        loudness[node] = sparse->loud[book->codes[node + 1]];
}
