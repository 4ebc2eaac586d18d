// SPDX-License-Identifier: Apache-2.0

#include "sparse.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sums.h"

struct sparse {
    const struct code *code;
    const struct sparse_code *book;
    struct certificate_limits limits;
    const float *expected;
    struct detector *detectors[2]; /* of a frame, and of another try of it */
    float *alike;                  /* (k, 2^m) products of codes, per chip, at the XOR of these */
    double *triangle;              /* (most that are told apart)² */
    float *levels, *swings;        /* (k, n), (n) V: of those who were heard, side by side, and as expected */
    int32_t *masks;                /* (n) of these, as code.sign_mask */
    struct words_measures measures;
    uint8_t *memory;               /* of what they said: */
    struct words said;
};

/* Products of codes i and j of a bit are one at i XOR j: the sum of the signs of this code's chips. */
static bool make_products(struct sparse *sparse)
{
    const struct code *code = sparse->code;
    const struct sparse_code *book = sparse->book;
    size_t most = book->capacity;

    sparse->alike = calloc(code->bits * book->rows, sizeof *sparse->alike);
    sparse->triangle = malloc(most * most * sizeof *sparse->triangle);
    if (!(sparse->alike && sparse->triangle))
        return false;
    for (size_t bit = 0; bit < code->bits; bit++)
        for (size_t i = 0; i < code->order; i++) {
            size_t place = (size_t)book->places[bit * code->order + i];
            sparse->alike[bit * book->rows + place] = 1.0f / (float)code->order;
        }
    transform_multiply(book->walsh, sparse->alike, sparse->alike, code->bits);
    return true;
}

/* Room for what those say who were heard. */
static bool make_words(struct sparse *sparse)
{
    struct words_measures *measures = &sparse->measures;
    const size_t nodes = sparse->code->nodes;

    sparse->memory = malloc(WORDS_BYTES * nodes);
    sparse->levels = malloc((sparse->code->bits + 4) * nodes * sizeof *sparse->levels);
    sparse->masks = malloc(3 * nodes * sizeof *sparse->masks);
    if (!(sparse->memory && sparse->levels && sparse->masks))
        return false;
    sparse->said = words_in(sparse->memory, nodes);
    measures->amplitude = sparse->said.amplitude;
    sparse->swings = sparse->levels + sparse->code->bits * nodes;
    measures->weakest = sparse->swings + nodes;
    measures->strongest = measures->weakest + nodes;
    measures->squares = measures->strongest + nodes;
    measures->signs = sparse->masks + nodes;
    measures->weakest_bit = measures->signs + nodes;
    return true;
}

struct sparse *sparse_new(const struct code *code, const struct certificate_limits *limits, const float *expected)
{
    const struct sparse_code *book = code->sparse;
    bool is_possible = code->bits && code->bits <= WORDS_MOST_BITS && code->order &&
                       code->nodes < book->rows && transform_order(book->walsh) == book->rows;
    struct sparse *sparse = is_possible ? calloc(1, sizeof *sparse) : NULL;

    if (!sparse)
        return NULL;
    sparse->code = code;
    sparse->book = book;
    sparse->limits = *limits;
    sparse->expected = expected;
    for (size_t i = 0; i < 2; i++)
        sparse->detectors[i] = detector_new(code);
    if (sparse->detectors[0] && sparse->detectors[1] && make_words(sparse) && make_products(sparse))
        return sparse;
    sparse_free(sparse);
    return NULL;
}

void sparse_free(struct sparse *sparse)
{
    if (!sparse)
        return;
    detector_free(sparse->detectors[0]);
    detector_free(sparse->detectors[1]);
    free(sparse->alike);
    free(sparse->triangle);
    free(sparse->levels);
    free(sparse->masks);
    free(sparse->memory);
    free(sparse);
}

/* ---- the clauses --------------------------------------------------------------------------------- */

/* Whether no other bits of those who spoke would give nearly the same chips. To turn two bits or more changes the
 * power of a bit's chips by 8 λ amplitudes squared, or more, where λ is the least eigenvalue of the codes' products:
 * by the pivots of Cholesky's decomposition. chance: A², by which noise of a bit may be off. */
static bool are_told_apart(const struct sparse *sparse, const struct listed *found, double chance)
{
    const size_t rows = sparse->book->rows;
    double least = (sparse->limits.left + chance) / 8, *row = sparse->triangle;

    for (size_t bit = 0; sparse->book->may_cancel && bit < sparse->code->bits; bit++) {
        const float *alike = sparse->alike + bit * rows;
        for (size_t i = 0; i < found->count; i++)
            for (size_t j = 0; j <= i; j++) {
                double sum = (double)alike[found->codes[i] ^ found->codes[j]] - (i == j ? least : 0);
                for (size_t l = 0; l < j; l++)
                    sum -= row[i * found->count + l] * row[j * found->count + l];
                if (i == j && !(sum > 0))
                    return false;
                row[i * found->count + j] = i == j ? sqrt(sum) : sum / row[j * found->count + j];
            }
    }
    return true;
}

/* Share by which the mean square of so much noise may be off. */
static double by_chance(const struct sparse *sparse, size_t count)
{
    return sparse->limits.deviations * sqrt(2 / (double)count);
}

/* Noise of a chip, V², beyond which words are uncertain. What is lost of a word in a bit, or turned, leaves
 * more than an amplitude squared there; what it says then is noise, of which little reaches the margin of a
 * word that is claimed. */
static double most_noise(const struct sparse *sparse)
{
    const struct certificate_limits *limits = &sparse->limits;
    double swing = (double)sparse->code->swing, order = (double)sparse->code->order;
    double margin = (double)limits->words.low_margin / limits->deviations;

    return fmax(1 / by_chance(sparse, sparse->code->order), order * margin * margin) * swing * swing;
}

/* The certificate of what a detector has found. */
static void judge(const struct sparse *sparse, const struct detector *detector,
                  const struct certificate_view *view, struct certificate *certificate)
{
    const struct code *code = sparse->code;
    const struct listed *found = &detector->next;
    const size_t chips = code->bits * code->order, count = found->count;
    const double swing = (double)code->swing, free = fmax((double)chips - (double)count - 1, 1);
    struct certificate_residue residue = {.left = detector->left, .bits = code->bits, .order = code->order,
                                    .free = free, .noise_v2 = view->noise_v2, .swing = swing,
                                    .more = certificate_more(&sparse->limits, (double)count) * swing * swing,
                                    .better = detector->settled ? detector->change : 0, .speakers = count};
    float loudest = 0;

    *certificate = (struct certificate){.swing = swing, .speakers = count};
    certificate->value[CLAUSE_ENERGY] = certificate_energy(&sparse->limits, &residue, &certificate->left);
    certificate->row_noise_v = sqrt(certificate->left / (double)code->order);
    double hides = certificate->left / most_noise(sparse);
    certificate->value[CLAUSE_ENERGY] = fmax(certificate->value[CLAUSE_ENERGY], hides);
    for (size_t i = 0; i < count; i++)
        loudest = fmaxf(loudest, detector->loud[found->codes[i]]);
    double faint = count ? sparse->book->faintest * swing / (double)loudest : 0;
    double crowd = (double)count / (double)(sparse->book->capacity + 1);
    certificate->value[CLAUSE_WORDS] = detector->settled ? fmax(faint, crowd) : 2;
    certificate->understood = detector->settled && crowd < 1;
    if (certificate->understood) {
        double chance = by_chance(sparse, code->order) * view->noise_v2 / (swing * swing);
        certificate->crowded = !are_told_apart(sparse, found, chance);
        certificate->value[CLAUSE_RIVALS] = certificate->crowded ? 2 : 0;
    }
}

/* Judges other words, and whether they are better; then they replace the best ones. */
static void prefer(const struct sparse *sparse, const struct certificate_view *view,
                   const struct detector *other, const struct detector **best,
                   struct certificate *certificate)
{
    struct certificate found;

    judge(sparse, other, view, &found);
    if (found.left < certificate->left) {
        *certificate = found;
        *best = other;
    }
}

/* The pair of a bit's words, or one twice, of which turning the bits leaves least. Returns the power, per
 * chip, that this adds. rests: what is left on the rows of so many words. */
static double best_pair(const struct listed *found, const float *words, const float *rests,
                        const float *alike, size_t pair[2])
{
    double best = INFINITY;

    for (size_t i = 0; i < found->count; i++) {
        float one = 4 * words[i] * (words[i] + rests[i]);
        for (size_t j = 0; j <= i; j++) {
            float other = 4 * words[j] * (words[j] + rests[j]);
            float product = alike[found->codes[i] ^ found->codes[j]];
            float both = i == j ? one : one + other + 8 * words[i] * words[j] * product;
            if ((double)both < best) {
                best = (double)both;
                pair[0] = i;
                pair[1] = j;
            }
        }
    }
    return best;
}

/* Finds words in the chips of another detector, from its words on, of which bits are turned, two of a bit at a time,
 * as long as that leaves less. Turns of all words stop where no single bit that is turned leaves less; of few chips
 * two may. */
static void turn_bits(const struct sparse *sparse, struct detector *detector, const struct detector *from)
{
    const size_t rows = detector->book->rows, count = from->next.count, order = detector->code.order;
    const float *alike = sparse->alike;
    struct listed *turned = &detector->now;
    float *rests = detector->straight;
    size_t pair[2];

    turned->count = count;
    memcpy(turned->codes, from->next.codes, count * sizeof *turned->codes);
    memcpy(detector->chips, from->chips, detector->code.bits * order * sizeof *rests);
    for (size_t bit = 0; bit < detector->code.bits; bit++, alike += rows) {
        float *words = turned->words + bit * rows;
        const float *sums = detector_sums(from, bit);
        memcpy(words, from->next.words + bit * rows, count * sizeof *words);
        for (size_t i = 0; i < count; i++)
            rests[i] = sums[turned->codes[i]] / (float)order - words[i];
        for (size_t turn = 0; turn < detector->book->turns; turn++) {
            if (!(best_pair(turned, words, rests, alike, pair) < 0))
                break;
            for (size_t each = 0; each < (pair[0] == pair[1] ? 1 : 2); each++) {
                int32_t code = turned->codes[pair[each]];
                for (size_t i = 0; i < count; i++)
                    rests[i] += 2 * words[pair[each]] * alike[turned->codes[i] ^ code];
                words[pair[each]] *= -1;
            }
        }
    }
    detector_go_on(detector);
}

/* Finds words, and tries twice to find better ones where they are not certain. */
static const struct detector *find(struct sparse *sparse, const struct certificate_view *view,
                                   struct certificate *certificate)
{
    struct detector *first = sparse->detectors[0], *second = sparse->detectors[1];
    const struct detector *best = first;

    detector_find(first, view->chips, 0);
    judge(sparse, first, view, certificate);
    if (certificate_worst(certificate) < 1)
        return first;
    detector_find(second, view->chips, sparse->book->damping);
    prefer(sparse, view, second, &best, certificate);
    size_t count = best->next.count;
    bool is_quick = count * count < 16 * sparse->book->rows; /* to look for pairs, as a turn is */
    if (!(certificate_worst(certificate) < 1) && is_quick && certificate->understood) {
        struct detector *other = best == first ? second : first;
        turn_bits(sparse, other, best);
        prefer(sparse, view, other, &best, certificate);
    }
    return best;
}

/* ---- words --------------------------------------------------------------------------------------- */

/* Decides the words of those who were heard, side by side, and puts them in their places. noise: V RMS of a level. */
static void tell_words(struct sparse *sparse, const struct detector *detector, double noise, const struct words *words)
{
    const struct code *code = sparse->code;
    const struct listed *found = &detector->next;
    const struct words *said = &sparse->said;
    float *levels = sparse->levels;

    for (size_t bit = 0; bit < code->bits; bit++)
        for (size_t i = 0; i < found->count; i++)
            *levels++ = detector_sums(detector, bit)[found->codes[i]] / (float)code->order;
    words_measure(sparse->levels, found->count, code->bits, found->count, &sparse->measures);
    for (size_t i = 0; i < found->count; i++) {
        int32_t node = detector->nodes[found->codes[i]];
        sparse->swings[i] = sparse->expected[node];
        sparse->masks[i] = code->sign_mask[node];
        said->active[i] = said->amplitude[i] > code->active_share * sparse->swings[i];
    }
    struct code sent = *code;
    sent.nodes = found->count;
    sent.sign_mask = sparse->masks;
    words_decide(&sparse->measures, &sent, sparse->swings, (float)(1 / fmax(noise, 1e-12)),
                 &sparse->limits.words, said);
    for (size_t i = 0; i < found->count; i++) {
        int32_t node = detector->nodes[found->codes[i]];
        words->active[node] = said->active[i];
        words->doubtful[node] = said->doubtful[i];
        words->doubled[node] = said->doubled[i];
        words->odd[node] = said->odd[i];
        words->codes[node] = said->codes[i];
        words->amplitude[node] = said->amplitude[i];
        words->rho[node] = said->rho[i];
        words->margin[node] = said->margin[i];
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

/* Marks silent nodes on whose rows there is more than noise, V RMS of a level; they are in doubt. */
static void find_faint(const struct sparse *sparse, const struct detector *detector, double noise,
                       const struct words *words)
{
    const struct certificate_limits *limits = &sparse->limits;
    const size_t rows = sparse->book->rows, bits = sparse->code->bits;
    double faint = limits->faint * (double)sparse->code->swing, order = (double)sparse->code->order;
    double chance = certificate_chance((double)bits, limits->faint_deviations) * noise * noise;
    double most = (double)bits * fmax(faint * faint, chance);
    float *squares = detector->squares, *loud = detector->loud;

    for (size_t i = 0; i < detector->next.count; i++)
        if (sparse->said.active[i])
            loud[detector->next.codes[i]] = 0;
    /* The sum of squares is no more than the square of the sum; but for rounding. */
    if (!any_above(rows, loud, (float)(0.999 * sqrt(most) / (double)bits)))
        return;
    memset(squares, 0, rows * sizeof *squares);
    for (size_t bit = 0; bit < bits; bit++)
        add_squares(rows, detector_sums(detector, bit), squares);
    for (size_t node = 0; node < sparse->code->nodes; node++) {
        double square = (double)squares[sparse->book->numbers[node + 1]];
        words->faint[node] = !words->active[node] && square > most * order * order;
        words->doubtful[node] |= words->faint[node];
    }
}

/* ---- a frame ------------------------------------------------------------------------------------- */

/* How much of what is left may be noise, V² of a chip: all, or as much as in the median bit if there is more
 * in others. */
static double usual_left(const struct sparse *sparse, const struct detector *detector, double left)
{
    const struct code *code = sparse->code;
    double power[WORDS_MOST_BITS], swing = (double)code->swing;

    for (size_t bit = 0; bit < code->bits; bit++) {
        double here = sums_power(detector->left + bit * code->order, code->order) / (double)code->order;
        size_t at = bit;
        for (; at > 0 && power[at - 1] > here; at--)
            power[at] = power[at - 1];
        power[at] = here;
    }
    double median = power[code->bits / 2];
    double most = median * certificate_chance((double)code->order, sparse->limits.deviations);
    return power[code->bits - 1] < most + sparse->limits.left * swing * swing ? left : median;
}

/* Fourth moment of what is left over its power squared: 3 for noise; the chips of one node have 1, those of
 * a tone 1.5. */
VECTORS static double kurtosis_of(const float *left, size_t count, double power)
{
    float sums[8] = {0};
    double sum = 0;

    for (size_t i = 0; i + 8 <= count; i += 8)
        for (size_t lane = 0; lane < 8; lane++) {
            float square = left[i + lane] * left[i + lane];
            sums[lane] += square * square;
        }
    for (size_t lane = 0; lane < 8; lane++)
        sum += (double)sums[lane];
    return sum / (double)(count / 8 * 8) / (power * power);
}

/* Whether a node may have spoken that was not heard. */
static bool hides_nodes(const struct sparse *sparse, const struct certificate_view *view,
                        const struct certificate *certificate)
{
    const struct code *code = sparse->code;
    double swing2 = (double)code->swing * (double)code->swing;
    double known = view->noise_v2 * (1 - by_chance(sparse, code->bits * code->order));

    return certificate->row_noise_v * sparse->limits.silent_rho > (double)code->swing ||
           certificate->left - known > sparse->book->hidden * swing2 ||
           (!view->is_noise && view->noise_v2 > code->active_share * code->active_share * swing2);
}

void sparse_read(struct sparse *sparse, const struct certificate_view *view, const struct words *words,
                 struct certificate *certificate)
{
    const struct code *code = sparse->code;
    const size_t nodes = code->nodes, chips = code->bits * code->order;
    const struct detector *detector = find(sparse, view, certificate);

    memset(words->amplitude, 0, WORDS_BYTES * nodes);
    tell_words(sparse, detector, certificate->row_noise_v, words);
    find_faint(sparse, detector, certificate->row_noise_v, words);
    if (hides_nodes(sparse, view, certificate))
        for (size_t i = 0; i < nodes; i++)
            words->doubtful[i] |= !words->active[i];
    double swing = (double)code->swing, left = sums_power(detector->left, chips) / (double)chips;
    certificate->usual = usual_left(sparse, detector, certificate->left);
    certificate->kurtosis = kurtosis_of(detector->left, chips, fmax(left, 1e-12 * swing * swing));
    if (!detector->settled) {
        double power = (sums_power(view->chips, chips) / (double)chips - view->noise_v2) / (swing * swing);
        certificate->speakers = (size_t)fmin(fmax(0, round(power)), (double)nodes);
    }
}
