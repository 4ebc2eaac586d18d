// SPDX-License-Identifier: Apache-2.0

#include "certifier.h"

#include <math.h>
#include <string.h>

#include "sums.h"

VECTORS static void flip(const float *flips, size_t size, const float *from, float *to)
{
    for (size_t i = 0; i < size; i++)
        to[i] = from[i] * flips[i];
}

void certifier_rows(const struct code *code, const float *chips, float *rows)
{
    if (code->flips) {
        flip(code->flips, code->bits * code->order, chips, rows);
        chips = rows;
    }
    transform_multiply(code->correlate, chips, rows, code->bits);
}

void certifier_chips(const struct code *code, const float *rows, float *chips)
{
    transform_multiply(code->spread, rows, chips, code->bits);
    if (code->flips)
        flip(code->flips, code->bits * code->order, chips, chips);
}

/* Words of constant amplitude: rows that hold ±amplitude where a node spoke, (k, N); what they hold where it is
 * broken. */
VECTORS static void make_symbols(const struct code *code, const float *restrict rows, const float *restrict amplitude,
                                 const uint8_t *restrict active, const uint8_t *restrict broken,
                                 float *restrict symbols)
{
    const size_t end = code->first + code->nodes;

    for (size_t bit = 0; bit < code->bits; bit++, rows += code->order, symbols += code->order) {
        memset(symbols, 0, code->first * sizeof *symbols);
        for (size_t i = 0; i < code->nodes; i++) {
            float level = rows[code->first + i], word = active[i] ? copysignf(amplitude[i], level) : 0;
            symbols[code->first + i] = broken[i] ? level : word;
        }
        memset(symbols + end, 0, (code->order - end) * sizeof *symbols);
    }
}

VECTORS void certifier_leave(const struct certifier *certifier, const float *restrict chips, float *restrict left)
{
    const size_t bits = certifier->code->bits, order = certifier->code->order;
    const bool has_offset = certifier->code->first > 0 || certifier->code->scrambled;
    const float *restrict model = certifier->model;

    for (size_t bit = 0; bit < bits; bit++, chips += order, model += order, left += order) {
        const size_t whole = order & ~(size_t)7;
        floats8 sums = {0};
        float sum = 0;
        for (size_t i = 0; i < whole; i += 8) {
            floats8 eight = *(const floats8 *)(chips + i) - *(const floats8 *)(model + i);
            *(floats8 *)(left + i) = eight;
            sums += eight;
        }
        for (size_t i = whole; i < order; i++)
            sum += left[i] = chips[i] - model[i];
        for (size_t lane = 0; lane < 8; lane++)
            sum += sums[lane];
        float offset = has_offset ? sum / (float)order : 0;
        for (size_t i = 0; has_offset && i < order; i++)
            left[i] -= offset;
        certifier->offset[bit] = offset;
    }
}

VECTORS void certifier_take_off(const float *from, float share, size_t size, float *left)
{
    for (size_t i = 0; i < size; i++)
        left[i] -= share * from[i];
}

/* Takes off what leaks from the chip before and the one after, the same share for all; least squares of two. False,
 * and nothing is taken off, where they explain no more than chance does. power: V², sum of squares of what is left.
 * chip_before, chip_after: next to the frame. */
VECTORS static bool take_leakage(const struct certifier *certifier, double power, float *chip_before, float *chip_after)
{
    const float *model = certifier->model;
    float *left = left_of(certifier);
    const size_t chips = certifier->code->bits * certifier->code->order;
    const double most = certifier->limits.leak, by_chance = 2 * certifier->limits.log_odds / (double)chips;
    double before = sums_power(model, chips - 1), after = sums_power(model + 1, chips - 1);
    double both = sums_dot(model, model + 2, chips - 2);
    double of_before = sums_dot(model, left + 1, chips - 1), of_after = sums_dot(model + 1, left, chips - 1);
    double tiny = 1e-9 * (before + after), determinant = (before + tiny) * (after + tiny) - both * both;

    if (!(determinant > 0))
        return false;
    double late = ((after + tiny) * of_before - both * of_after) / determinant;
    double early = ((before + tiny) * of_after - both * of_before) / determinant;
    if (late * of_before + early * of_after < by_chance * power)
        return false;
    late = fmin(fmax(late, -most), most);
    early = fmin(fmax(early, -most), most);
    certifier_take_off(model, (float)late, chips - 1, left + 1);
    certifier_take_off(model + 1, (float)early, chips - 1, left);
    *chip_before -= (float)early * model[0];
    *chip_after -= (float)late * model[chips - 1];
    return true;
}

/* The chips beside a frame without the offset that goes on there; of unipolar drive it ends with the words. */
static void take_offset(const struct certifier *certifier, size_t side, float *beside)
{
    const struct code *code = certifier->code;
    const float *offset = certifier->offset;
    const size_t last = code->bits - 1;

    if (code->unipolar)
        return;
    float before = offset[0] + 0.5f * (offset[0] - offset[1]);
    float after = offset[last] + 0.5f * (offset[last] - offset[last - 1]);
    for (size_t i = 0; i < side; i++) {
        beside[i] -= before;
        beside[side + i] -= after;
    }
}

VECTORS double certifier_greatest(const float *values, size_t size)
{
    const size_t whole = size & ~(size_t)7;
    floats8 most = {0};
    float greatest = 0;

    for (size_t i = 0; i < whole; i += 8) {
        ints8 absolute = *(const ints8 *)(values + i) & INT32_MAX;
        ints8 is_more = (floats8)absolute > most;
        most = (floats8)((absolute & is_more) | ((ints8)most & ~is_more));
    }
    for (size_t lane = 0; lane < 8; lane++)
        greatest = fmaxf(greatest, most[lane]);
    for (size_t i = whole; i < size; i++)
        greatest = fabsf(values[i]) > greatest ? fabsf(values[i]) : greatest;
    return (double)greatest;
}

VECTORS void certifier_means(const float *restrict rows, size_t step, size_t bits, size_t size, float *restrict mean)
{
    memset(mean, 0, size * sizeof *mean);
    for (size_t bit = 0; bit < bits; bit++, rows += step)
        for (size_t i = 0; i < size; i++)
            mean[i] += fabsf(rows[i]);
    for (size_t i = 0; i < size; i++)
        mean[i] /= (float)bits;
}

VECTORS static void squares_of_columns(const float *restrict rows, size_t order, size_t bits, float *restrict power,
                                       float *restrict most)
{
    memset(power, 0, order * sizeof *power);
    memset(most, 0, order * sizeof *most);
    for (size_t bit = 0; bit < bits; bit++, rows += order)
        for (size_t i = 0; i < order; i++) {
            float square = rows[i] * rows[i];
            power[i] += square;
            most[i] = square > most[i] ? square : most[i];
        }
}

VECTORS double certifier_rows_left(struct certifier *certifier, const float *rows, const struct words *words, bool *differ)
{
    const struct code *code = certifier->code;
    float *mean = certifier->mean, loudest;
    size_t from = code->first > 0 && !code->scrambled;
    double total = 0;

    certifier_means(rows + code->first, code->order, code->bits, code->nodes, mean);
    float usual = words_usual(mean, code->nodes, (float)certifier->limits.loud_share, &loudest);
    if (!isnan(code->swing))
        usual = fminf(loudest, code->swing);
    float least = fmaxf(code->active_share * usual, (float)certifier->limits.loud_share * loudest);
    for (size_t bit = 0; bit < code->bits; bit++)
        total += sums_power(rows + bit * code->order + from, code->order - from);
    *differ = false;
    for (size_t i = 0; i < code->nodes; i++) {
        bool spoke = mean[i] > least;
        if (words)
            *differ |= spoke != words->active[i];
        mean[i] = spoke ? mean[i] : 0;
        total -= (double)code->bits * (double)mean[i] * (double)mean[i];
        for (size_t bit = 0; words && spoke && !*differ && bit < code->bits; bit++) {
            size_t at = bit * code->order + code->first + i;
            *differ = (rows[at] > 0) != (certifier->rows[at] > 0);
        }
    }
    return total * (double)code->order;
}

double certifier_left(struct certifier *certifier, const float *chips, double *power)
{
    const struct code *code = certifier->code;
    const double size = (double)(code->bits * code->order);
    bool differ;

    *power = sums_power(chips, code->bits * code->order) / size;
    certifier_rows(code, chips, certifier->rows);
    for (size_t bit = 0; bit < code->bits && code->unipolar && code->first > 0 && !code->scrambled; bit++) {
        double offset = (double)certifier->rows[bit * code->order];
        *power -= offset * offset / (double)code->bits;
    }
    return certifier_rows_left(certifier, certifier->rows, NULL, &differ) / size;
}

double certifier_gain(struct certifier *certifier, const float *chips, size_t bits)
{
    struct code code = *certifier->code;

    code.bits = bits;
    certifier_rows(&code, chips, certifier->rows);
    certifier_means(certifier->rows + code.first, code.order, bits, code.nodes, certifier->mean);
    return sums_power(certifier->mean, code.nodes);
}

/* Rows (k, N) as words of these amplitudes have them: their signs, and nothing on rows of no node. */
VECTORS static void make_words(const struct code *code, const float *restrict amplitude, float *restrict rows)
{
    const size_t end = code->first + code->nodes;

    for (size_t bit = 0; bit < code->bits; bit++, rows += code->order) {
        memset(rows, 0, code->first * sizeof *rows);
        for (size_t i = 0; i < code->nodes; i++)
            rows[code->first + i] = copysignf(amplitude[i], rows[code->first + i]);
        memset(rows + end, 0, (code->order - end) * sizeof *rows);
    }
}

void certifier_model(struct certifier *certifier, const float *chips, float *model)
{
    const struct code *code = certifier->code;
    const size_t size = code->bits * code->order;
    double offset = 0;
    bool differ;

    certifier_rows(code, chips, model);
    certifier_rows_left(certifier, model, NULL, &differ);
    for (size_t at = 0; at < size && code->unipolar; at += code->order)
        offset += (double)model[at] / (double)code->bits;
    make_words(code, certifier->mean, model);
    certifier_chips(code, model, model);
    for (size_t i = 0; code->unipolar && i < size; i++)
        model[i] += (float)offset;
}

double certifier_sum_beside(const float *beside, size_t count)
{
    double sum = 0;

    for (size_t i = 0; i < count; i++)
        sum += isnan(beside[i]) ? 0 : (double)beside[i] * (double)beside[i];
    return sum;
}

VECTORS double certifier_beside(struct certifier *certifier, const struct certificate_view *view)
{
    const struct code *code = certifier->code;
    float *beside = certifier->beside;

    memcpy(beside, view->beside, 2 * view->side * sizeof *beside);
    if (code->first > 0 || code->scrambled)
        take_offset(certifier, view->side, beside);
    memcpy(certifier->leaked, beside, 2 * view->side * sizeof *beside);
    double power = sums_power(left_of(certifier), code->bits * code->order);
    certifier->leaks = take_leakage(certifier, power, beside + view->side - 1, beside + view->side);
    return power;
}

VECTORS double certifier_beyond_edges(const struct certifier *certifier, size_t side)
{
    const float *left = left_of(certifier), *beside = certifier->beside, edges = (float)certifier->edges;
    double sum = 0;

    for (size_t i = 0; i < certifier->code->bits * certifier->code->order; i++) {
        double more = (double)fmaxf(fabsf(left[i]) - edges, 0);
        sum += more * more;
    }
    for (size_t i = 0; i < 2 * side; i++) {
        double more = isnan(beside[i]) ? 0 : (double)fmaxf(fabsf(beside[i]) - edges, 0);
        sum += more * more;
    }
    return sum;
}

/* What words leave on rows, (k, N): the frame's without the words', and without the offsets, which are on row 0 unless
 * codes are scrambled. */
VECTORS static void subtract_words(const struct certifier *certifier, float *restrict symbols)
{
    const struct code *code = certifier->code;
    const float *restrict rows = certifier->rows, *restrict ones = certifier->ones;

    for (size_t bit = 0; bit < code->bits; bit++, rows += code->order, symbols += code->order) {
        for (size_t i = 0; i < code->order; i++)
            symbols[i] = rows[i] - symbols[i];
        for (size_t i = 0; ones && i < code->order; i++)
            symbols[i] -= certifier->offset[bit] * ones[bit * code->order + i];
        if (code->first > 0 && !ones)
            symbols[0] = 0;
    }
}

VECTORS struct reading certifier_residue(struct certifier *certifier, const struct certificate_view *view,
                                const struct words *words)
{
    const struct code *code = certifier->code;
    const size_t chips = code->bits * code->order;
    const bool has_offset = code->first > 0 || code->scrambled;
    struct reading reading = {.view = view, .side = view->side};

    if (!view->rows_known)
        certifier_rows(code, view->chips, certifier->rows);
    certifier->measures.amplitude = words->amplitude;
    words_measure(certifier->rows + code->first, code->order, code->bits, code->nodes, &certifier->measures);
    reading.speakers = certifier_speakers(certifier, view->noise_v2, words, &reading.weakest);
    reading.swing = isnan(code->swing) ? (double)certifier->expected[0] : (double)code->swing;
    reading.least = fmin(reading.swing, reading.weakest);
    make_symbols(code, certifier->rows, words->amplitude, words->active, certifier->broken, certifier->work);
    certifier_chips(code, certifier->work, certifier->model);
    certifier_leave(certifier, view->chips, left_of(certifier));
    double power = certifier_beside(certifier, view);
    reading.shown = power + certifier_sum_beside(certifier->leaked, 2 * view->side);
    double taken = (double)reading.speakers + (has_offset ? (double)code->bits : 0) + (reading.speakers ? 2 : 0);
    for (size_t i = 0; i < code->nodes; i++)
        taken += certifier->broken[i] ? (double)code->bits : 0;
    reading.free = fmax((double)chips - taken, 1);
    reading.total = certifier->leaks ? sums_power(left_of(certifier), chips) : power;
    reading.left = fmax(reading.total / reading.free, 1e-12 * reading.swing * reading.swing);
    reading.more = certificate_more(&certifier->limits, (double)reading.speakers) * reading.swing * reading.swing;
    if (certifier->leaks)
        certifier_rows(code, left_of(certifier), certifier->work);
    else
        subtract_words(certifier, certifier->work);
    squares_of_columns(certifier->work, code->order, code->bits, certifier->power, certifier->most);
    return reading;
}

VECTORS double certifier_explained(struct certifier *certifier, const float *chips)
{
    const struct code *code = certifier->code;
    const size_t size = code->bits * code->order;
    double offsets = 0;
    float beside;

    certifier_model(certifier, chips, certifier->model);
    certifier_leave(certifier, chips, left_of(certifier));
    take_leakage(certifier, sums_power(left_of(certifier), size), &beside, &beside);
    for (size_t bit = 0; bit < code->bits; bit++)
        offsets += (double)certifier->offset[bit] * (double)certifier->offset[bit];
    return sums_power(chips, size) - sums_power(left_of(certifier), size) - (double)code->order * offsets;
}
