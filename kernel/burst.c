// SPDX-License-Identifier: Apache-2.0

#include "burst.h"

#include <math.h>

#include "fit.h"
#include "vectors.h"

static double least_of(double some, double other)
{
    return some < other ? some : other;
}

static double most_of(double some, double other)
{
    return some > other ? some : other;
}

size_t burst_scratch(size_t count)
{
    return 2 * (count + 1);
}

/* Mean of a half chip. */
static inline double mean_of(const double *volts, size_t half)
{
    double sum = 0;

    for (size_t i = 0; i < half; i++)
        sum += volts[i];
    return sum * (1.0 / (double)half);
}

INLINE void find_halves(const double *restrict volts, size_t count, const size_t half,
                        double *restrict means)
{
    for (size_t i = 0; i < count; i++)
        means[i] = mean_of(volts + i * half, half);
}

VECTORS void burst_halves(const struct burst_search *search, const double *volts, size_t size,
                          double *means)
{
    if (search->half == 2) /* of four samples per chip: a constant, so that it is done for many at once */
        find_halves(volts, size / 2, 2, means);
    else
        find_halves(volts, size / search->half, search->half, means);
}

VECTORS bool burst_gap(const struct burst_search *search, const double *means, size_t count,
                       const struct burst_gap *known, struct burst_gap *gap, double *scratch)
{
    size_t width = search->window < count ? search->window : count;
    double *squares = scratch, level = 0;

    if (width < 4)
        return false;
    for (size_t i = 0; i < count; i++)
        squares[i + 1] = (means[i] - known->level) * (means[i] - known->level);
    fit_sums(squares + 1, count, 0, squares);
    if (isnan(squares[count]))
        return false;
    size_t windows = count - width + 1, i = 0;
    double least[4], where[4] = {0}; /* of every fourth window, so that four are compared at once */
    for (size_t lane = 0; lane < 4; lane++)
        least[lane] = squares[width] - squares[0];
    for (; i + 4 <= windows; i += 4)
        for (size_t lane = 0; lane < 4; lane++) {
            double power = squares[i + lane + width] - squares[i + lane], place = (double)(i + lane);
            where[lane] = power < least[lane] ? place : where[lane];
            least[lane] = power < least[lane] ? power : least[lane];
        }
    size_t begin = (size_t)where[0];
    for (size_t lane = 1; lane < 4; lane++)
        begin = least[lane] < squares[begin + width] - squares[begin] ? (size_t)where[lane] : begin;
    for (; i < windows; i++)
        begin = squares[i + width] - squares[i] < squares[begin + width] - squares[begin] ? i : begin;
    for (size_t i = begin; i < begin + width; i++)
        level += means[i] - known->level;
    level /= (double)width;
    gap->begin = begin * search->half;
    double least_power = squares[begin + width] - squares[begin];
    double fresh = search->bias * most_of(least_power / (double)width - level * level, 0);
    gap->level = known->level + level;
    gap->variance = least_of((1 - search->newest) * known->variance + search->newest * fresh,
                             search->calmer * fresh);
    return true;
}

/* What a search finds on the way: energy (count) of half chips, gain (cells + 1) of cells. */
struct view {
    size_t count, cells;
    double *energy, *gain;
};

/* Cells from `begin` to `end` that may be the frame: of all of a possible length those with the greatest
 * excess over half of its power, without quiet ones at the ends. */
static void cut_frame(const struct burst_search *search, const struct view *view, size_t low,
                      size_t *begin, size_t *end)
{
    const double *gain = view->gain;
    double best = -INFINITY;
    size_t top = 0, span = search->high - search->low;

    for (size_t b = 0; b + low <= view->cells; b++) {
        size_t first = b + low, last = first + span < view->cells ? first + span : view->cells;
        if (b && top >= first)
            top = gain[last] > gain[top] ? last : top;
        else
            for (size_t i = top = first; i <= last; i++)
                top = gain[i] > gain[top] ? i : top;
        if (gain[top] - gain[b] > best) {
            best = gain[top] - gain[b];
            *begin = b;
            *end = top;
        }
    }
    size_t first = *begin, last = *end > search->bit ? *end - search->bit : *end;
    for (size_t i = first; i <= *begin + search->bit && i <= view->cells; i++)
        first = gain[i] < gain[first] ? i : first;
    for (size_t i = last; i <= *end; i++)
        last = gain[i] > gain[last] ? i : last;
    *begin = first;
    *end = last;
}

/* Where the frame is first silent for longer than one would be: every bit has the same energy, and `width`
 * holds a whole one. half_power: what the cells' gain lacks. */
static size_t pause_of(const struct burst_search *search, const struct view *view, size_t first, size_t last,
                       double half_power, double power, double variance, double limit)
{
    double least = (double)search->width * (0.2 * power + variance), sum = 0;
    size_t cells = search->width / search->group, cell = first / search->group;

    cells -= cells > 0; /* whole ones of a window; mostly they hold enough */
    while (cell + cells <= last / search->group &&
           (view->gain[cell + cells] - view->gain[cell] + (double)cells * half_power) *
                   (double)search->group > 1.001 * least)
        cell++;
    if (cell + cells > last / search->group)
        return last;
    for (size_t i = first; i < last; i++) {
        sum += view->energy[i] - (i - first < search->width ? 0 : view->energy[i - search->width]);
        if (i + 1 - first < search->width || sum >= least)
            continue;
        size_t begin = i + 1 - search->width, stop = begin + search->width, pause = begin;
        for (size_t next = begin; next < stop && next < view->count; next++)
            pause = view->energy[next] > limit ? next + 1 : pause;
        return pause;
    }
    return last;
}

bool burst_find(const struct burst_search *search, const double *means, size_t count, double least_power,
                const struct burst_gap *gap, struct burst_found *found, double *scratch)
{
    size_t group = search->group, begin = 0, end = 0;
    struct view view = {count, count / group, scratch, scratch + count};
    size_t low = search->low < view.cells ? search->low : view.cells;
    double sum = 0, peak = 0, variance = gap->variance;

    if (low < 8)
        return false;
    for (size_t i = 0; i < count; i++)
        view.energy[i] = (means[i] - gap->level) * (means[i] - gap->level);
    for (size_t cell = 0; cell < view.cells; cell++) {
        view.gain[cell + 1] = mean_of(view.energy + cell * group, group);
        sum += view.gain[cell + 1] - (cell < low ? 0 : view.gain[cell + 1 - low]);
        peak = cell + 1 >= low && sum > peak ? sum : peak;
    }
    peak /= (double)low;
    variance = most_of(variance, 1e-8 * peak);
    double power = peak - variance, half_power = variance + 0.5 * power;
    if (!(power >= most_of(search->no_power,
                           most_of(search->snr_floor * variance, least_power))))
        return false;
    view.gain[0] = 0;
    for (size_t cell = 0; cell < view.cells; cell++)
        view.gain[cell + 1] = view.gain[cell] + (view.gain[cell + 1] - half_power);
    cut_frame(search, &view, low, &begin, &end);
    /* Loud half chips are sharper than that, and reach beyond where chips are small. Hum stays below. */
    double node_power = most_of(least_power, power / (16 * (double)search->nodes));
    double limit = most_of(search->loud * search->loud * variance, node_power);
    size_t first = begin * group, last = end * group, reach = search->bit * group;
    size_t from = first > reach ? first - reach : 0, i = from, until = last + reach;
    while (i < first + group && i < count && !(view.energy[i] > limit))
        i++;
    bool sharp = i < first + group && i < count;
    size_t back = until < count ? until : count, least = last > group ? last - group : 0;
    while (back > least && !(view.energy[back - 1] > limit))
        back--;
    sharp = sharp && back > least;
    first = i < first + group && i < count ? i : first;
    last = back > least ? back : last;
    double snr = power / variance;
    size_t pause = last;
    if (snr > 8 && last > first + search->width)
        pause = pause_of(search, &view, first, last, half_power, power, variance, limit);
    found->slack = search->chip * (1.5 + 60.0 / snr);
    if (!sharp)
        found->slack += (double)(search->half * (group - 1));
    found->first = (double)(first * search->half) - 0.5;
    found->last = (double)(last * search->half) - 0.5;
    found->pause = (double)(pause * search->half) - 0.5;
    found->power = power;
    found->variance = variance;
    return true;
}

/* One side of a frame: half chips, nearest first, of `count` samples from `volts` on. */
static size_t side_of(const double *volts, size_t count, double level, size_t half, bool backwards,
                      float *side)
{
    size_t halves = count / half;

    for (size_t i = 0; i < halves; i++) {
        const double *from = backwards ? volts + count - (i + 1) * half : volts + i * half;
        side[i] = (float)(mean_of(from, half) - level);
    }
    return halves;
}

static bool is_quiet(const struct burst_search *search, const float *side, size_t count,
                     double variance, double power)
{
    double sum = 0, squares = 0, size = (double)(count < search->side ? count : search->side);

    for (size_t i = 0; i < count && i < search->side; i++) {
        sum += (double)side[i];
        squares += (double)side[i] * (double)side[i];
    }
    double excess = squares / size - variance * (1.5 + 5 * sqrt(2 / size));
    double drift = fabs(sum / size) - 6 * sqrt(variance / size);
    return !(drift > search->beside_level * sqrt(power) || excess > search->beside * power);
}

struct burst_beside burst_beside(const struct burst_search *search, const double *volts, size_t size,
                                 double level, size_t first, size_t end, double variance, double power,
                                 float *scratch)
{
    size_t begin = first > search->gap_size ? first - search->gap_size : 0;
    size_t stop = end + search->gap_size < size ? end + search->gap_size : size;
    size_t before = side_of(volts + begin, first - begin, level, search->half, true, scratch);
    size_t after =
        end < stop ? side_of(volts + end, stop - end, level, search->half, false, scratch + before) : 0;
    struct burst_beside found = {0, variance, true, variance};
    float *steps = scratch + before + after;
    size_t count = 0;

    for (size_t i = 0; i < before + after; i++) {
        found.level += (double)scratch[i] / (double)(before + after);
        float step = scratch[i] - (i ? scratch[i - 1] : 0);
        steps[count] = step * step;
        count += i != 0 && i != before;
    }
    if (count >= 8) {
        double noise = (double)fit_ranked(steps, (ptrdiff_t)count, (ptrdiff_t)count / 2);
        noise /= 2 * search->median;
        found.noise = noise;
        if (noise > 0)
            found.variance = most_of(noise, least_of(variance, search->drifting * noise));
    }
    found.noise *= (double)search->half;
    found.quiet = is_quiet(search, scratch, before, found.variance, power) &&
                  is_quiet(search, scratch + before, after, found.variance, power);
    return found;
}
