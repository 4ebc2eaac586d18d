// SPDX-License-Identifier: Apache-2.0

#include "fit.h"

#include <math.h>
#include <string.h>

#include "vectors.h"

#define BLOCK 64 /* instants that are looked at together */
#define LANES 4 /* sums that are kept apart, so that they can be added at once */

/* By eights, because an addition that waits for the one before takes eight times as long. */
void fit_sums(const float *values, size_t size, double level, double *sums)
{
    double sum = sums[0] = 0;
    size_t i = 0;

    for (; i + 8 <= size; i += 8, sums += 8) {
        double v[8];
        for (size_t j = 0; j < 8; j++)
            v[j] = (double)values[i + j] - level;
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
        sums[1] = sum += (double)values[i] - level;
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
        sums[i] = line->sums[place[i]] + sums[i] * ((double)line->volts[place[i]] - line->level);
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

/* Sums of a least squares fit, in several parts: of weights, weights times edge, and times edge²; of moments, and
 * times edge. */
struct sums {
    double of[5][LANES];
};

/* Adds the edges from number `first` on, of which those beyond the last have no weight. */
INLINE void add_edges(size_t first, const double *weights, const double *moments, struct sums *sums)
{
    double place[BLOCK];

    for (int32_t i = 0; i < BLOCK; i++)
        place[i] = (double)first + (double)i;
    for (size_t i = 0; i < BLOCK; i += LANES)
        for (size_t lane = 0; lane < LANES; lane++) {
            double number = place[i + lane], weight = weights[i + lane], moment = moments[i + lane];
            sums->of[0][lane] += weight;
            sums->of[1][lane] += weight * number;
            sums->of[2][lane] += weight * (number * number);
            sums->of[3][lane] += moment;
            sums->of[4][lane] += moment * number;
        }
}

/* The fit that these sums move a fit to. */
static struct fit solved(const struct sums *sums, struct fit fit, double earliest, double latest)
{
    double w[5];

    for (size_t i = 0; i < 5; i++)
        w[i] = sums->of[i][0] + (sums->of[i][1] + sums->of[i][2] + sums->of[i][3]);
    double determinant = w[0] * w[2] - w[1] * w[1], start = fit.start;
    if (determinant > 1e-9 * w[0] * w[2])
        start += (w[2] * w[3] - w[1] * w[4]) / determinant;
    start = fmin(fmax(start, earliest), latest);
    double longer = w[2] > 0 ? (w[4] - w[1] * (start - fit.start)) / w[2] : 0;
    return (struct fit){start, fit.chip + longer};
}

/* Weighted least squares of how late edges come: of `count` edges, edge i between level i and i + 1 of the
 * model. */
VECTORS static struct sums weigh_edges(const struct fit_line *line, struct fit fit, double reach, size_t count,
                                       const float *levels)
{
    double left[BLOCK + 1], right[BLOCK + 1], unused[BLOCK + 1];
    double least = reach - 0.5, most = (double)line->size - 0.5 - reach;
    struct sums sums = {{{0}}};

    for (size_t done = 0; done < count; done += BLOCK, levels += BLOCK) {
        size_t size = count - done < BLOCK ? count - done : BLOCK;
        double first = fit.start + fit.chip * (double)done;
        double weights[BLOCK] = {0}, moments[BLOCK] = {0};
        integrate(line, first - reach, fit.chip, 1, size, left, unused);
        integrate(line, first + reach, fit.chip, 1, size, right, unused);
        for (int32_t i = 0; i < (int32_t)size; i++) {
            double edge = first + fit.chip * (double)i;
            double before = (double)levels[i], after = (double)levels[i + 1];
            double step = edge >= least && edge <= most ? before - after : 0;
            weights[i] = step * step;
            moments[i] = step * (right[i] - left[i] - reach * (before + after));
        }
        add_edges(done, weights, moments, &sums);
    }
    return sums;
}

size_t fit_scratch(const struct code *code)
{
    return 2 * code->bits * code->order + 2 + code->span;
}

struct fit fit_refine(const struct code *code, const struct fit_line *line, const struct fit_refining *refining,
                      struct certifier *certifier, struct fit fit, double earliest, double latest, float *scratch)
{
    const size_t count = code->bits * code->order;
    float *chips = scratch, *model = chips + count, *levels = model + count;

    for (size_t turn = 0; turn < refining->turns; turn++) {
        fit_levels(line, &fit, refining->blur, 0, code->span, levels);
        for (size_t i = 0; i < count; i++)
            chips[i] = levels[code->places[i]];
        certifier_model(certifier, chips, model);
        memset(levels, 0, (code->span + 2) * sizeof *levels); /* the gap on either side, and pauses */
        for (size_t i = 0; i < count; i++)
            levels[code->places[i] + 1] = model[i];
        struct sums sums = weigh_edges(line, fit, refining->reaches[turn] * fit.chip, code->span + 1, levels);
        struct fit next = solved(&sums, fit, earliest, latest);
        double change = fabs(next.start - fit.start) + fabs(next.chip - fit.chip) * (double)code->span;
        bool settled = change < refining->settled_chips * next.chip;
        fit = next;
        if (settled)
            break;
    }
    return fit;
}
