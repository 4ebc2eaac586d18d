// SPDX-License-Identifier: Apache-2.0

#include "fit.h"

#include <math.h>
#include <string.h>

struct place {
    ptrdiff_t whole; /* signed: what converts such to a double is one instruction */
    double share;
};

/* The sample that an instant lies in, and the share of it that has passed. */
static inline struct place place_of(const struct fit_line *line, double time)
{
    double size = (double)line->size, shifted = time + 0.5;

    shifted = shifted > 0 ? shifted : 0;
    shifted = shifted < size ? shifted : size;
    ptrdiff_t whole = (ptrdiff_t)shifted, last = (ptrdiff_t)line->size - 1;
    whole = whole < last ? whole : last;
    return (struct place){whole, shifted - (double)whole};
}

static inline double sum_before(const struct fit_line *line, struct place place)
{
    return line->sums[place.whole] + place.share * line->volts[place.whole];
}

void fit_levels(const struct fit_line *line, const struct fit *fit, double blur, size_t lead,
                size_t count, float *levels)
{
    double before = 0, number_before = 0;

    for (ptrdiff_t i = 0; i <= (ptrdiff_t)count; i++) {
        struct place place = place_of(line, fit->start + fit->chip * (double)(i - (ptrdiff_t)lead));
        double share = (place.share - 0.5) / blur + 0.5;
        place.share = share < 0 ? 0 : share > 1 ? 1 : share;
        double sum = sum_before(line, place), number = (double)place.whole + place.share;
        if (i) {
            double size = number - number_before;
            levels[i - 1] = (float)((sum - before) / (size < 0.5 ? 0.5 : size));
        }
        before = sum;
        number_before = number;
    }
}

void fit_chips(const struct fit_code *code, const float *levels, size_t bits, float *chips)
{
    size_t size = bits * code->frame.order;

    if (code->span == code->frame.bits * code->frame.order)
        memcpy(chips, levels, size * sizeof *chips);
    else
        for (size_t i = 0; i < size; i++)
            chips[i] = levels[code->places[i]];
    for (size_t i = 0; code->flips && i < size; i++)
        chips[i] *= code->flips[i];
}

void fit_symbols(const struct fit_code *code, size_t bits, const float *rows, const float *amplitude,
                 float *symbols)
{
    const struct words_frame *frame = &code->frame;

    memset(symbols, 0, bits * frame->order * sizeof *symbols);
    for (size_t at = frame->first; at < bits * frame->order; at += frame->order)
        for (size_t i = 0; i < frame->nodes; i++) {
            float level = amplitude[i];
            symbols[at + i] = rows[at + i] > 0 ? level : rows[at + i] < 0 ? -level : 0;
        }
}

void fit_model(const struct fit_code *code, size_t bits, float pedestal, float *chips)
{
    size_t size = bits * code->frame.order;

    for (size_t i = 0; code->flips && i < size; i++)
        chips[i] *= code->flips[i];
    for (size_t i = 0; code->frame.unipolar && i < size; i++)
        chips[i] += pedestal;
}

/* Weighted least squares of how late edges come: of `count` edges, edge i between level i and i + 1 of the
 * model. */
static struct fit moved(const struct fit_line *line, struct fit fit, double reach, size_t count,
                        const float *levels, double earliest, double latest)
{
    double w0 = 0, w1 = 0, w2 = 0, m0 = 0, m1 = 0, most = (double)line->size - 0.5;

    for (ptrdiff_t i = 0; i < (ptrdiff_t)count; i++) {
        double number = (double)i, edge = fit.start + fit.chip * number;
        double before = (double)levels[i], after = (double)levels[i + 1], step = before - after;
        if (step == 0 || edge < reach - 0.5 || edge + reach > most)
            continue;
        double area = sum_before(line, place_of(line, edge + reach)) -
                      sum_before(line, place_of(line, edge - reach)) - reach * (before + after);
        double weight = step * step, moment = step * area;
        w0 += weight;
        w1 += weight * number;
        w2 += weight * (number * number);
        m0 += moment;
        m1 += moment * number;
    }
    double determinant = w0 * w2 - w1 * w1, start = fit.start;
    if (determinant > 1e-9 * w0 * w2)
        start += (w2 * m0 - w1 * m1) / determinant;
    start = start > earliest ? start : earliest;
    start = start < latest ? start : latest;
    double longer = w2 > 0 ? (m1 - w1 * (start - fit.start)) / w2 : 0;
    return (struct fit){start, fit.chip + longer};
}

size_t fit_scratch(const struct fit_code *code)
{
    const struct words_frame *frame = &code->frame;

    return 2 * frame->bits * frame->order + 2 + code->span + 2 * frame->nodes;
}

struct fit fit_refine(const struct fit_code *code, const struct fit_line *line,
                      const struct fit_refining *refining, struct fit fit, double earliest,
                      double latest, float *scratch)
{
    const struct words_frame *frame = &code->frame;
    size_t chips = frame->bits * frame->order;
    float *rows = scratch, *model = rows + chips, *levels = model + chips + 2;
    float *amplitude = levels + code->span, *uneven = amplitude + frame->nodes;
    float pedestal, power, spread, misfit;

    for (size_t turn = 0; turn < refining->turns; turn++) {
        fit_levels(line, &fit, refining->blur, 0, code->span, levels);
        fit_chips(code, levels, frame->bits, rows);
        transform_multiply(code->correlate, rows, rows, frame->bits);
        words_fit(frame, rows, amplitude, uneven, &pedestal, &power, &spread, &misfit);
        model[0] = model[chips + 1] = 0; /* the gap on either side */
        fit_symbols(code, frame->bits, rows, amplitude, model + 1);
        transform_multiply(code->spread, model + 1, model + 1, frame->bits);
        fit_model(code, frame->bits, pedestal, model + 1);
        struct fit next = moved(line, fit, refining->reaches[turn] * fit.chip, chips + 1, model,
                                earliest, latest);
        double change = fabs(next.start - fit.start) + fabs(next.chip - fit.chip) * (double)chips;
        bool settled = change < refining->settled_chips * next.chip;
        fit = next;
        if (settled)
            break;
    }
    return fit;
}

float fit_ranked(float *values, ptrdiff_t size, ptrdiff_t rank)
{
    ptrdiff_t low = 0, high = size - 1;

    while (low < high) {
        float pivot = values[rank];
        ptrdiff_t i = low, j = high;
        while (i <= j) {
            while (values[i] < pivot)
                i++;
            while (pivot < values[j])
                j--;
            if (i <= j) {
                float swapped = values[i];
                values[i++] = values[j];
                values[j--] = swapped;
            }
        }
        low = j < rank ? i : low;
        high = rank < i ? j : high;
    }
    return values[rank];
}
