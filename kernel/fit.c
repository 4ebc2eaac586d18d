// SPDX-License-Identifier: Apache-2.0

#include "fit.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "vectors.h"

#define MORE_NOISE 1.5 /* times the gap's noise that a carried timing may leave before it is refined */
#define NEAR 0.7     /* share of what a frame's words explain, from which on others may explain as much when refined */
#define ENDS 8       /* places, half a chip apart, at which a frame may end that begins at a known one */
#define BLOCK 64 /* instants that are looked at together */
#define LANES 4 /* sums that are kept apart, so that they can be added at once */

VECTORS void samples_volts(const int16_t *restrict counts, size_t size, float zero, float per_count, float most,
                           float *restrict volts)
{
    for (size_t i = 0; i < size; i++) {
        float level = ((float)counts[i] - zero) * per_count;
        volts[i] = fabsf(level) < most ? level : NAN;
    }
}

VECTORS struct samples_sums samples_add(const float *volts, size_t size)
{
    doubles4 sum[2] = {{0}, {0}}, squares[2] = {{0}, {0}};
    struct samples_sums all = {0, 0};
    size_t i = 0;

    for (; i + 8 <= size; i += 8)
        for (size_t half = 0; half < 2; half++) {
            doubles4 four = __builtin_convertvector(*(const floats4 *)(volts + i + 4 * half), doubles4);
            sum[half] += four;
            squares[half] += four * four;
        }
    for (; i < size; i++) {
        double level = (double)volts[i];
        all.sum += level;
        all.squares += level * level;
    }
    for (size_t lane = 0; lane < 8; lane++) {
        all.sum += sum[lane / 4][lane % 4];
        all.squares += squares[lane / 4][lane % 4];
    }
    return all;
}

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

/* Weighted least squares of how late edges come: of `count` edges, edge i between level i and i + 1 of the model. */
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

/* ---- a frame's fit ------------------------------------------------------------------------------ */

bool fitter_make(struct fitter *fitter, const struct code *code, struct fit_rules *rules, struct certifier *certifier)
{
    *fitter = (struct fitter){.code = code, .rules = rules, .certifier = certifier};
    fitter->levels = malloc((code->span + 2 * rules->side) * sizeof(float));
    fitter->halves = malloc(2 * code->span * sizeof(float));
    fitter->chips = malloc(2 * code->bits * code->order * sizeof(float));
    fitter->split = fitter->chips ? fitter->chips + code->bits * code->order : NULL;
    fitter->scratch = malloc((2 * code->bits * code->order + code->span + 2) * sizeof(float));
    return fitter->levels && fitter->halves && fitter->chips && fitter->scratch;
}

void fitter_free(struct fitter *fitter)
{
    free(fitter->levels);
    free(fitter->halves);
    free(fitter->chips);
    free(fitter->scratch);
    free(fitter->sums);
}

bool fitter_line(struct fitter *fitter, const float *volts, size_t count, double level)
{
    if (fitter->room <= count) {
        double *sums = realloc(fitter->sums, 2 * (count + 1) * sizeof *sums);
        if (!sums)
            return false;
        fitter->sums = sums;
        fitter->room = 2 * (count + 1);
    }
    fit_sums(volts, count, level, fitter->sums);
    fitter->line = (struct fit_line){count, volts, fitter->sums, level};
    return true;
}

/* The first `count` chips of a frame, without the pauses that levels have. */
static void pick(const struct code *code, const float *levels, size_t count, float *chips)
{
    if (code->span == code->bits * code->order)
        memcpy(chips, levels, count * sizeof *levels);
    else
        for (size_t i = 0; i < count; i++)
            chips[i] = levels[code->places[i]];
}

/* Chips of the fit in fitter->levels, read so many later, into fitter->chips. */
static void pick_chips(struct fitter *fitter, int shift)
{
    const struct code *code = fitter->code;

    pick(code, fitter->levels + fitter->rules->side + shift, code->bits * code->order, fitter->chips);
}

void fitter_take(struct fitter *fitter, const struct fit *fit)
{
    const size_t side = fitter->rules->side;

    fitter->taken = *fit;
    fit_levels(&fitter->line, fit, fitter->rules->blur, side, fitter->code->span + 2 * side, fitter->levels);
    pick_chips(fitter, 0);
}

VECTORS const float *fitter_split(struct fitter *fitter, const struct fit *fit)
{
    const struct code *code = fitter->code;
    const struct fit halves = {fit->start, fit->chip / 2};

    fit_levels(&fitter->line, &halves, fitter->rules->blur, 0, 2 * code->span, fitter->halves);
    for (size_t i = 0; i < code->bits * code->order; i++) {
        const float *chip = fitter->halves + 2 * code->places[i];
        fitter->split[i] = (chip[0] - chip[1]) / 2;
    }
    return fitter->split;
}

/* Moves start and chip duration to where the level changes of the decided words are.
 *
 * Around edge j the area between line and model is (v[j−1] − v[j])·τ[j] for an edge that comes τ[j] late;
 * τ = δstart + j·δchip is fitted by least squares, in which big steps count most. This is repeated ever closer to the
 * edges, until nothing moves. earliest, latest: bounds of the start. Edges out of view are left out. */
static struct fit refine(struct fitter *fitter, struct fit fit, double earliest, double latest)
{
    const struct code *code = fitter->code;
    const struct fit_rules *rules = fitter->rules;
    const size_t count = code->bits * code->order;
    float *chips = fitter->scratch, *model = chips + count, *levels = model + count;

    for (size_t turn = 0; turn < rules->turns; turn++) {
        fit_levels(&fitter->line, &fit, rules->blur, 0, code->span, levels);
        pick(code, levels, count, chips);
        certifier_model(fitter->certifier, chips, model);
        memset(levels, 0, (code->span + 2) * sizeof *levels); /* the gap on either side, and pauses */
        for (size_t i = 0; i < count; i++)
            levels[code->places[i] + 1] = model[i];
        struct sums sums = weigh_edges(&fitter->line, fit, rules->reaches[turn] * fit.chip, code->span + 1, levels);
        struct fit next = solved(&sums, fit, earliest, latest);
        double change = fabs(next.start - fit.start) + fabs(next.chip - fit.chip) * (double)code->span;
        bool settled = change < rules->settled_chips * next.chip;
        fit = next;
        if (settled)
            break;
    }
    return fit;
}

bool fitter_is_poor(const struct fitter *fitter, double left, double power, double noise)
{
    return left > fitter->rules->searched * power + 3 * noise;
}

/* Whether a fit is within the limits, and its frame within the samples. */
static bool is_possible(const struct fitter *fitter, const struct fit *fit)
{
    const struct fit_rules *rules = fitter->rules;

    return fit->chip >= rules->least_chip && fit->chip <= rules->most_chip &&
           !(fitter->is_free && fit->start < -FIT_EDGE) &&
           fit_end(fit, fitter->code->span) <= (double)fitter->line.size - FIT_EDGE + 0.3 * fit->chip;
}

bool fitter_find(struct fitter *fitter, double noise, struct fit *best, double *left, double *power)
{
    const struct fit_rules *rules = fitter->rules;
    const struct fit nominal = {0.5 * (rules->earliest + rules->latest) - 0.25, rules->chip};
    const struct fit begin = fitter->carried.chip > 0 ? fitter->carried : nominal;
    struct fit tries[] = {fitter->carried, fitter->proposed, begin, fitter->proposed};
    bool any = false;

    *left = *power = INFINITY;
    for (size_t i = 0; i < 4; i++) {
        struct fit fit = tries[i];
        double over, of_chips;
        if (!(fit.chip > 0))
            continue;
        if (i >= 2)
            fit = refine(fitter, fit, rules->earliest, rules->latest);
        if (!is_possible(fitter, &fit)) {
            fit = i >= 2 ? tries[i] : fit;
            if (!is_possible(fitter, &fit))
                continue;
        }
        fitter_take(fitter, &fit);
        over = certifier_left(fitter->certifier, fitter->chips, &of_chips);
        if (!any || over < 0.98 * *left || fitter->measures) {
            *best = fit;
            *left = over;
            *power = of_chips;
        }
        any = true;
        if (*left < MORE_NOISE * noise + rules->refined * *power && !fitter->measures)
            break;
    }
    return any;
}

/* A place beside, with its own best timing where words explain more by that: the timing of one place suits the words of
 * no other. power: V², sum of squares that they explain. */
static void refine_place(struct fitter *fitter, struct fit *there, double *power)
{
    struct fit own = refine(fitter, *there, -INFINITY, INFINITY);

    if (!(fabs(own.start - there->start) < there->chip / 2 && is_possible(fitter, &own)))
        return;
    fitter_take(fitter, &own);
    double refined = certifier_explained(fitter->certifier, fitter->chips);
    if (refined > *power) {
        *there = own;
        *power = refined;
    }
}

void fitter_choose(struct fitter *fitter, struct fit *best)
{
    const int side = (int)fitter->rules->side;
    const struct fit here = *best;
    double powers[2 * CERTIFICATE_BESIDE + 1] = {0}, *at = powers + side; /* V² that words explain there */
    int moved = 0;

    fitter_take(fitter, &here);
    for (int shift = -side; shift <= side; shift++) {
        struct fit there = {here.start + shift * here.chip, here.chip};
        if (shift && !is_possible(fitter, &there))
            continue;
        pick_chips(fitter, shift);
        at[shift] = certifier_explained(fitter->certifier, fitter->chips);
    }
    double most = at[0], least = fmax(NEAR * most, 0);
    fitter->place_count = 0;
    for (int shift = -side; shift <= side; shift++) {
        if (!shift || !(at[shift] > least)) /* nor is there one where words explain nothing, or it is not known what */
            continue;
        struct fit there = {here.start + shift * here.chip, here.chip};
        refine_place(fitter, &there, &at[shift]);
        struct fit_place *place = &fitter->places[fitter->place_count++];
        *place = (struct fit_place){there, shift};
        if (at[shift] > (1 + fitter->rules->tied) * most) {
            *place = (struct fit_place){*best, moved};
            *best = there;
            moved = shift;
            most = at[shift];
        }
    }
    for (size_t i = 0; i < fitter->place_count; i++)
        fitter->places[i].shift -= moved;
}

void fitter_explained(struct fitter *fitter, struct fit fit, size_t count, double *powers)
{
    for (size_t i = 0; i < count; i++, fit.start += fit.chip) {
        double power;
        fitter_take(fitter, &fit);
        double left = certifier_left(fitter->certifier, fitter->chips, &power);
        powers[i] = power - left;
    }
}

double fitter_duration(struct fitter *fitter, double noise, double start, double loud)
{
    const struct fit_rules *rules = fitter->rules;
    double most = 0, chip = 0, left = INFINITY, power = 0;
    const struct fit_line *line = &fitter->line;
    size_t end = line->size;

    /* Impulses, and what noise does once in a while, are loud for one sample. */
    while (end > 1 && !(fabs((double)line->volts[end - 1] - line->level) > loud &&
                        fabs((double)line->volts[end - 2] - line->level) > loud))
        end--;
    for (size_t i = 0; i < ENDS && fitter_is_poor(fitter, left, power, noise); i++) {
        double later = 0.5 * (double)((i + 2) % ENDS) - 1;
        double length = (double)end - FIT_EDGE + later * rules->chip - start;
        struct fit fit = {start, fmin(fmax(length / (double)fitter->code->span, rules->least_chip), rules->most_chip)};
        fitter_take(fitter, &fit);
        left = certifier_left(fitter->certifier, fitter->chips, &power);
        if ((power - left) * fit.chip > most) {
            most = (power - left) * fit.chip;
            chip = fit.chip;
        }
    }
    return chip;
}

void fitter_gains(struct fitter *fitter, double start, size_t bits, const double *chips, size_t count, double *gains)
{
    const size_t size = bits * fitter->code->order, span = size ? (size_t)fitter->code->places[size - 1] + 1 : 0;

    for (size_t i = 0; i < count; i++) {
        struct fit fit = {start, chips[i]};
        fit_levels(&fitter->line, &fit, fitter->rules->blur, 0, span, fitter->levels);
        pick(fitter->code, fitter->levels, size, fitter->chips);
        gains[i] = certifier_gain(fitter->certifier, fitter->chips, bits) * fit.chip;
    }
}
