// SPDX-License-Identifier: Apache-2.0

#include "fit.h"

#include <math.h>
#include <string.h>

#include "vectors.h"

#define BLOCK 64 /* instants that are looked at together */
#define LANES 4 /* sums that are kept apart, so that they can be added at once */

/* By eights, because an addition that waits for the one before takes eight times as long. */
void fit_sums(const double *values, size_t size, double level, double *sums)
{
    double sum = sums[0] = 0;
    size_t i = 0;

    for (; i + 8 <= size; i += 8, sums += 8) {
        double v[8];
        for (size_t j = 0; j < 8; j++)
            v[j] = values[i + j] - level;
        double two = v[0] + v[1], four = two + (v[2] + v[3]), six = four + (v[4] + v[5]);
        sums[1] = sum + v[0];
        sums[2] = sum + two;
        sums[3] = sum + (two + v[2]);
        sums[4] = sum + four;
        sums[5] = sum + (four + v[4]);
        sums[6] = sum + six;
        sums[7] = sum + (six + v[6]);
        sums[8] = sum += six + (v[6] + v[7]);
    }
    for (; i < size; i++, sums++)
        sums[1] = sum += values[i] - level;
}

/* The line's integral up to `count` instants, `step` samples apart, and the number of samples that went by. An
 * instant passes the sample that it lies in within `blur` of it. */
INLINE void integrate(const struct fit_line *line, double first, double step, double blur, size_t count,
                      double *restrict sums, double *restrict numbers)
{
    double size = (double)line->size, last = size - 1, sharp = 1 / blur;
    int32_t place[BLOCK + 1];

    for (int32_t i = 0; i < (int32_t)count; i++) {
        double time = first + step * (double)i + 0.5;
        time = time > 0 ? time : 0;
        time = time < size ? time : size;
        double whole = (double)(int32_t)time;
        whole = whole < last ? whole : last;
        double share = (time - whole - 0.5) * sharp + 0.5;
        share = share < 0 ? 0 : share > 1 ? 1 : share;
        place[i] = (int32_t)whole;
        numbers[i] = whole + share;
        sums[i] = share;
    }
    for (size_t i = 0; i < count; i++)
        sums[i] = line->sums[place[i]] + sums[i] * (line->volts[place[i]] - line->level);
}

VECTORS void fit_levels(const struct fit_line *line, const struct fit *fit, double blur, size_t lead,
                        size_t count, float *levels)
{
    double sums[BLOCK + 1], numbers[BLOCK + 1];

    for (size_t done = 0; done < count; done += BLOCK, levels += BLOCK) {
        size_t size = count - done < BLOCK ? count - done : BLOCK;
        double first = fit->start + fit->chip * (double)((ptrdiff_t)done - (ptrdiff_t)lead);
        integrate(line, first, fit->chip, blur, size + 1, sums, numbers);
        for (size_t i = 0; i < size; i++) {
            double number = numbers[i + 1] - numbers[i];
            levels[i] = (float)((sums[i + 1] - sums[i]) / (number < 0.5 ? 0.5 : number));
        }
    }
}

VECTORS double fit_turned(const struct fit_line *line, const struct fit *fit, double inner, double blur,
                          size_t count)
{
    double sums[3][BLOCK], numbers[3][BLOCK], squares = 0;

    for (size_t done = 0; done < count; done += BLOCK) {
        size_t size = count - done < BLOCK ? count - done : BLOCK;
        double middle = fit->start + fit->chip * ((double)done + 0.5);
        for (int edge = 0; edge < 3; edge++)
            integrate(line, middle + (edge - 1) * inner * fit->chip, fit->chip, blur, size, sums[edge], numbers[edge]);
        for (size_t i = 0; i < size; i++) {
            double before = numbers[1][i] - numbers[0][i], behind = numbers[2][i] - numbers[1][i];
            double turn = (sums[2][i] - sums[1][i]) / (behind < 0.5 ? 0.5 : behind) -
                          (sums[1][i] - sums[0][i]) / (before < 0.5 ? 0.5 : before);
            squares += turn * turn;
        }
    }
    return squares / (double)count;
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

VECTORS void fit_symbols(const struct fit_code *code, size_t bits, const float *rows,
                         const float *amplitude, float *symbols)
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
VECTORS static struct fit moved(const struct fit_line *line, struct fit fit, double reach, size_t count,
                                const float *levels, double earliest, double latest)
{
    double left[BLOCK + 1], other[BLOCK], unused[BLOCK + 1], all[5][LANES] = {{0}};
    double least = reach - 0.5, most = (double)line->size - 0.5 - reach;
    const double *right = 2 * reach == fit.chip ? left + 1 : other; /* where the next edge's left is */

    for (size_t done = 0; done < count; done += BLOCK, levels += BLOCK) {
        size_t size = count - done < BLOCK ? count - done : BLOCK;
        double first = fit.start + fit.chip * (double)done, place[BLOCK];
        double weights[BLOCK] = {0}, moments[BLOCK] = {0};
        integrate(line, first - reach, fit.chip, 1, size + 1, left, unused);
        if (right == other)
            integrate(line, first + reach, fit.chip, 1, size, other, unused);
        for (int32_t i = 0; i < (int32_t)size; i++) {
            double edge = first + fit.chip * (double)i;
            double before = (double)levels[i], after = (double)levels[i + 1];
            double step = edge >= least && edge <= most ? before - after : 0;
            weights[i] = step * step;
            moments[i] = step * (right[i] - left[i] - reach * (before + after));
        }
        for (int32_t i = 0; i < BLOCK; i++)
            place[i] = (double)done + (double)i;
        for (size_t i = 0; i < BLOCK; i += LANES)
            for (size_t lane = 0; lane < LANES; lane++) {
                double number = place[i + lane], weight = weights[i + lane], moment = moments[i + lane];
                all[0][lane] += weight;
                all[1][lane] += weight * number;
                all[2][lane] += weight * (number * number);
                all[3][lane] += moment;
                all[4][lane] += moment * number;
            }
    }
    for (size_t i = 0; i < 5; i++)
        all[i][0] += all[i][1] + all[i][2] + all[i][3];
    double w0 = all[0][0], w1 = all[1][0], w2 = all[2][0], m0 = all[3][0], m1 = all[4][0];
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
