// SPDX-License-Identifier: Apache-2.0

#include "sparse.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "vectors.h"

struct sparse {
    struct detector *detector;
    struct sparse_rules rules;
    double swing2;    /* V² */
    double least;     /* noise since it was shown to be more, V² */
    float *alike;     /* (k, 2^m) products of codes, at the XOR of these; NULL in long books */
    double *triangle; /* (most that are told apart)² */
};

/* Products of codes i and j of a bit are one at i XOR j: the sum of the signs of this code's chips. */
static bool make_products(struct sparse *sparse)
{
    const struct sparse_book *book = &sparse->detector->book;
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
    bool is_possible = book->bits && book->bits <= WORDS_MOST_BITS && book->order && book->nodes &&
                       book->nodes < book->rows && transform_order(book->walsh) == book->rows &&
                       rules->capacity <= book->nodes;
    struct sparse *sparse = is_possible ? calloc(1, sizeof *sparse) : NULL;

    if (!sparse)
        return NULL;
    sparse->rules = *rules;
    sparse->swing2 = rules->detect.swing * rules->detect.swing;
    sparse->detector = detector_new(book, &rules->detect);
    if (sparse->detector && (!rules->alike || make_products(sparse)))
        return sparse;
    sparse_free(sparse);
    return NULL;
}

void sparse_free(struct sparse *sparse)
{
    if (!sparse)
        return;
    detector_free(sparse->detector);
    free(sparse->alike);
    free(sparse->triangle);
    free(sparse);
}

struct detector *sparse_detector(const struct sparse *sparse)
{
    return sparse->detector;
}

const struct sparse_book *sparse_book(const struct sparse *sparse)
{
    return &sparse->detector->book;
}

/* ---- the certificate ----------------------------------------------------------------------------- */

/* Mean square of the noise of chips, of so much power that is left: words have taken their share of it. */
static double noise_of(const struct detector *detector, double power)
{
    double chips = (double)(detector->book.bits * detector->book.order);
    double left = chips - (double)detector->next.count - 1;

    return power * (chips / (left < 1 ? 1 : left));
}

/* As SparseRecogniser._are_told_apart: by the pivots of Cholesky's decomposition. */
static bool are_told_apart(const struct sparse *sparse, double noise)
{
    const struct sparse_rules *rules = &sparse->rules;
    const struct detector *detector = sparse->detector;
    const struct sparse_book *book = &detector->book;
    const int32_t *codes = detector->next.codes;
    size_t count = detector->next.count;
    double least = (rules->more + rules->chance_of_bit * noise / sparse->swing2) / 8;
    double *row = sparse->triangle;

    for (size_t bit = 0; sparse->alike && bit < book->bits; bit++) {
        const float *alike = sparse->alike + bit * book->rows;
        for (size_t i = 0; i < count; i++)
            for (size_t j = 0; j <= i; j++) {
                double sum = (double)alike[codes[i] ^ codes[j]] - (i == j ? least : 0);
                for (size_t l = 0; l < j; l++)
                    sum -= row[i * count + l] * row[j * count + l];
                if (i == j && !(sum > 0))
                    return false;
                row[i * count + j] = i == j ? sqrt(sum) : sum / row[j * count + j];
            }
    }
    return true;
}

/* Whether there are words, and all are faint; see FAINTEST in sparse_timing.py. */
static bool all_are_faint(const struct sparse *sparse)
{
    const struct detector *detector = sparse->detector;
    float loudest = 0;

    for (size_t i = 0; i < detector->next.count; i++)
        loudest = fmaxf(loudest, detector->loud[detector->next.codes[i]]);
    return loudest > 0 && loudest < (float)sparse->rules.faintest;
}

/* What so many words may leave beside noise, V². */
static double more_than_noise(const struct sparse *sparse, size_t words)
{
    const struct sparse_rules *rules = &sparse->rules;

    return (rules->more + rules->tolerance * rules->tolerance * (double)words) * sparse->swing2;
}

static bool hides_nodes(const struct sparse *sparse, double noise, double more)
{
    return 3 * sparse->rules.chance * noise + more > sparse->swing2;
}

/* Whether the words leave no more than noise that hides nobody, in any bit, and no others would leave
 * nearly as little. */
static bool words_explain(const struct sparse *sparse, double noise)
{
    const struct sparse_rules *rules = &sparse->rules;
    const struct detector *detector = sparse->detector;
    const size_t bits = detector->book.bits, count = detector->next.count;
    double more = more_than_noise(sparse, count), mean = 0, most = 0, power = 0;

    for (size_t bit = 0; bit < bits; bit++) {
        mean += noise_of(detector, detector->power[bit]) / (double)bits;
        most = fmax(most, noise_of(detector, detector->power[bit]));
        power += detector->power[bit] / (double)bits;
    }
    return count <= rules->capacity && power < rules->most_noise && !hides_nodes(sparse, noise, more) &&
           !all_are_faint(sparse) && mean < noise * (1 + rules->chance) + more &&
           most < noise * (1 + rules->chance_of_bit) + more && are_told_apart(sparse, noise);
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

/* Whether the row of anyone who did not speak holds more than noise (V², of a level); see rises in amplitude.py. */
static bool silence_rises(struct sparse *sparse, double noise)
{
    struct detector *detector = sparse->detector;
    const struct sparse_book *book = &detector->book;
    float *squares = detector->squares, *loud = detector->loud, order2 = (float)book->order * (float)book->order;
    float most = fmaxf((float)sparse->rules.silent_square, (float)(sparse->rules.silent_power * noise));

    for (size_t i = 0; i < detector->next.count; i++)
        loud[detector->next.codes[i]] = 0;
    /* The sum of squares is no more than the square of the sum; but for rounding. */
    float least = 0.999f * sqrtf(most) / (float)book->bits;
    if (!any_above(book->rows, loud, least))
        return false;
    memset(squares, 0, book->rows * sizeof *squares);
    for (size_t bit = 0; bit < book->bits; bit++)
        add_squares(book->rows, detector_sums(detector, bit), squares);
    for (size_t i = 0; i < detector->unused_count; i++)
        squares[detector->unused[i]] = 0;
    for (size_t i = 0; i < detector->next.count; i++)
        squares[detector->next.codes[i]] = 0;
    return any_above(book->rows, squares, most * order2);
}

/* ---- a frame ------------------------------------------------------------------------------------- */

double sparse_learn(struct sparse *sparse, double noise, double found)
{
    double rise = 1 + sparse->rules.chance;

    if (!(noise > 0))
        return found;
    sparse->least = noise > rise * sparse->least ? noise : fmin(noise, sparse->least);
    if (found > rise * sparse->least)
        return noise;
    return fmin(noise + sparse->rules.weight * (found - noise), rise * sparse->least);
}

/* Levels of those who spoke. */
static void tell_spoken(const struct detector *detector, float *levels, int32_t *spoke)
{
    const struct sparse_book *book = &detector->book;
    const struct listed *next = &detector->next;

    for (size_t i = 0; i < next->count; i++)
        spoke[i] = detector->nodes[next->codes[i]];
    for (size_t bit = 0; bit < book->bits; bit++) {
        const float *sums = detector_sums(detector, bit);
        for (size_t i = 0; i < next->count; i++)
            *levels++ = sums[next->codes[i]] * (1.0f / (float)book->order);
    }
}

bool sparse_read(struct sparse *sparse, const float *chips, double *noise, float *levels, int32_t *spoke,
                 struct sparse_told *told)
{
    struct detector *detector = sparse->detector;
    const struct sparse_rules *rules = &sparse->rules;
    const struct sparse_book *book = &detector->book;
    double found = 0;

    if (!(*noise > 0 && *noise <= rules->hiding) || hides_nodes(sparse, *noise, more_than_noise(sparse, 0)) ||
        !detector_find(detector, chips, 0))
        return false;
    for (size_t bit = 0; bit < book->bits; bit++)
        found += noise_of(detector, detector->power[bit]);
    found /= (double)book->bits;
    if (!words_explain(sparse, *noise) || silence_rises(sparse, found / (double)book->order))
        return false;
    tell_spoken(detector, levels, spoke);
    *told = (struct sparse_told){detector->level, sqrt(found / (double)book->order), detector->next.count};
    *noise = sparse_learn(sparse, *noise, found);
    return true;
}
