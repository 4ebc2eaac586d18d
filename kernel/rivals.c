// SPDX-License-Identifier: Apache-2.0

#include "certifier.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sums.h"

double certifier_twin(const struct certifier *certifier, const struct reading *reading, const struct code_twin *twin,
                   const float *rows, float amplitude)
{
    const struct code *code = certifier->code;
    const size_t bits = code->bits, order = code->order, lag = (size_t)abs(twin->shift);
    const float *sent = certifier->rows + code->first + twin->sent;
    const float *beside = certifier->beside + reading->side - (twin->shift > 0 ? 0 : lag);
    bool seen = !isnan(beside[0]) && !isnan(beside[lag - 1]);
    double sum = 0;

    for (size_t bit = 0; bit < bits; bit++) {
        float level = rows[bit * order + code->first + (size_t)twin->alike];
        level += copysignf(amplitude, sent[bit * order]) * twin->share;
        size_t other = twin->shift > 0 ? bit + 1 : bit - 1;
        if (other < bits)
            level += copysignf(amplitude, sent[other * order]) * twin->wrap;
        else if (!seen)
            level *= (float)order / (float)(order - lag);
        sum += fabs((double)level);
    }
    double there = sum / (double)bits, here = (double)amplitude;
    /* The chips at the other end of the frame, in which that one would be at rest. */
    double worse = (double)(bits * order) * (here * here - there * there) + (double)lag * here * here;
    double least = certifier_least_worse(certifier, reading, here);
    return worse > least * 1e-6 ? least / worse : 1e6;
}

/* The frame's chips without offsets, read later by a shift; chips beside the frame that were not seen are those that
 * the words would have there. */
static void read_shifted(struct certifier *certifier, const struct reading *reading, int shift, float *rows)
{
    const struct code *code = certifier->code;
    const size_t chips = code->bits * code->order;
    const size_t lag = (size_t)abs(shift);
    const float *beside = certifier->leaked + reading->side - (shift > 0 ? 0 : lag);
    const size_t hidden = shift > 0 ? chips - lag : 0;
    bool seen = true;

    for (size_t i = 0; i < chips; i++) {
        size_t from = i + (size_t)(ptrdiff_t)shift;
        if (from < chips)
            rows[i] = reading->view->chips[from] - certifier->offset[from / code->order];
    }
    for (size_t i = 0; i < lag; i++) {
        seen &= !isnan(beside[i]);
        rows[hidden + i] = isnan(beside[i]) ? 0 : beside[i];
    }
    if (!seen) {
        certifier_model(certifier, rows, certifier->other);
        for (size_t i = 0; i < lag; i++)
            rows[hidden + i] = isnan(beside[i]) ? certifier->other[hidden + i] : beside[i];
    }
    certifier_rows(code, rows, rows);
}

double certifier_shifted_frames(struct certifier *certifier, const struct reading *reading, const struct words *words,
                             int sign)
{
    const struct code *code = certifier->code;
    const size_t chips = code->bits * code->order, side = reading->side;
    const float *read = reading->view->chips, *offset = certifier->offset;
    double cut = 0, value = 0;
    double beside = certifier_sum_beside(certifier->leaked, 2 * side);
    double base = reading->shown + certifier->worse;
    bool differ;

    for (size_t lag = 1; lag <= side; lag++) {
        float *rows = certifier->work;
        double chip = sign > 0 ? (double)(read[lag - 1] - offset[0])
                               : (double)(read[chips - lag] - offset[code->bits - 1]);
        cut += chip * chip;
        if (cut > base)
            break;
        read_shifted(certifier, reading, sign * (int)lag, rows);
        double covered = certifier_sum_beside(certifier->leaked + side - (sign > 0 ? 0 : lag), lag);
        double left = certifier_rows_left(certifier, rows, words, &differ) + cut + beside - covered;
        if (differ && !reading->view->is_placed)
            value = fmax(value, base / fmax(left, 1e-30));
        for (size_t bit = 1; lag == 1 && bit < code->bits; bit++) {
            memcpy(certifier->other, certifier->rows, bit * code->order * sizeof *rows);
            memcpy(certifier->other + bit * code->order, rows + bit * code->order,
                   (code->bits - bit) * code->order * sizeof *rows);
            left = certifier_rows_left(certifier, certifier->other, words, &differ) + beside - covered;
            if (differ)
                value = fmax(value, base / fmax(left, 1e-30));
        }
    }
    return value;
}

/* How near chips come to being other words than those of the frame read last. */
static double other_words(struct certifier *certifier, const struct certificate_view *view, const struct words *words)
{
    bool differ;

    certifier_rows(certifier->code, view->chips, certifier->work);
    certifier_rows_left(certifier, certifier->work, words, &differ);
    if (!differ)
        return 0;
    certifier_model(certifier, view->chips, certifier->model);
    certifier_leave(certifier, view->chips, left_of(certifier));
    certifier_beside(certifier, view);
    double more = certifier_beyond_edges(certifier, view->side) - certifier->beyond;
    return certifier->worse / fmax(more, 1e-6 * certifier->worse);
}

/* Chips that are read `shift` chips later than the frame read last, without the word that a node has there. */
static struct certificate_view without(struct certifier *certifier, const struct certificate_view *view, int shift,
                                       const struct words *words, size_t node)
{
    const struct code *code = certifier->code;
    const size_t chips = code->bits * code->order, lag = (size_t)abs(shift), at = code->first + node;
    struct certificate_view others = *view;
    float *word = certifier->other, *left = certifier->without;

    memset(certifier->work, 0, chips * sizeof *certifier->work);
    for (size_t bit = 0; bit < chips; bit += code->order)
        certifier->work[bit + at] = copysignf(words->amplitude[node], certifier->rows[bit + at]);
    certifier_chips(code, certifier->work, word);
    memcpy(left, view->chips, chips * sizeof *left);
    if (shift > 0) {
        certifier_take_off(word + lag, 1, chips - lag, left);
        certifier_take_off(word, 1, lag, others.beside + view->side - lag);
    } else {
        certifier_take_off(word, 1, chips - lag, left + lag);
        certifier_take_off(word + chips - lag, 1, lag, others.beside + view->side);
    }
    others.chips = left;
    return others;
}

void certifier_compare(struct certifier *certifier, const struct certificate_view *view, int shift,
                       const struct words *words, struct certificate *certificate)
{
    double *value = &certificate->value[CLAUSE_RIVALS];

    if (!certificate->speakers)
        return;
    *value = fmax(*value, other_words(certifier, view, words));
    if (certificate->speakers == 1 || certificate->speakers > certifier->limits.few || certifier->code->unipolar ||
        abs(shift) > CERTIFICATE_SIDE)
        return;
    for (size_t node = 0; node < certifier->code->nodes; node++) {
        if (!words->active[node])
            continue;
        struct certificate_view others = without(certifier, view, shift, words, node);
        words->active[node] = 0; /* which is late or early, so that it seems to be in its place here */
        *value = fmax(*value, other_words(certifier, &others, words));
        words->active[node] = 1;
    }
}
