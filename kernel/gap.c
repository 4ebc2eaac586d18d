// SPDX-License-Identifier: Apache-2.0

#include "gap.h"

#include <math.h>

#include "vectors.h"

size_t gap_values(const struct burst_search *search, size_t samples)
{
    size_t halves = samples / search->half, burst = halves + burst_scratch(halves);

    return burst > samples + 1 ? burst : samples + 1;
}

size_t gap_scratch(const struct fit_code *code, const struct burst_search *search)
{
    size_t judge = judge_scratch(code), beside = 4 * (search->gap_size / search->half + 1), refine = fit_scratch(code);

    judge = judge < beside ? beside : judge;
    return code->span + JUDGE_MOST + (judge < refine ? refine : judge);
}

/* Whole chips by which rivals may begin earlier or later than a fit; as GapSearch._shifts_of. Whether that is not too
 * many, and silence after all of them in view; if the fit is not, proven is 0. */
static bool find_shifts(const struct fit_code *code, const struct gap_rules *rules, size_t size,
                        struct gap_seen *seen, double *earliest, double *latest)
{
    const struct burst_found *burst = &seen->burst;
    const struct fit *fit = &seen->fit;
    double length = (double)code->span * fit->chip, bit = (double)code->frame.order * fit->chip;
    double end = fit->start + length;
    double low = burst->last - length, high = burst->last + bit - length;

    low = low > burst->first - bit ? low : burst->first - bit;
    high = high < burst->first ? high : burst->first;
    low = ceil((low - burst->slack - fit->start) / fit->chip);
    high = floor((high + burst->slack - fit->start) / fit->chip);
    *earliest = (low < 0 ? low : 0) - rules->beyond;
    *latest = (high > 0 ? high : 0) + rules->beyond;
    seen->proven = fit->start >= -0.5 && end <= (double)size ? end + *latest * fit->chip : 0;
    return seen->proven > 0 && seen->proven <= (double)size && *latest - *earliest < JUDGE_MOST;
}

/* The words of a frame; levels: of the chips from its first one on. */
static void read_words(const struct fit_code *code, const float *levels, const struct judge_words *words)
{
    fit_chips(code, levels, code->frame.bits, words->rows);
    transform_multiply(code->correlate, words->rows, words->rows, code->frame.bits);
    words_fit(&code->frame, words->rows, words->amplitude, words->uneven, words->pedestal, words->power, words->spread,
              words->misfit);
}

/* As Expected.log_prior, negative. */
static double cost_of_place(const struct gap_expected *expected, double wide_chips, double start)
{
    const double pi = 3.14159265358979323846;
    double off = (start - expected->start) / expected->chip, width = expected->scatter / expected->chip;
    double wide = expected->slips / (pi * wide_chips) / (1 + off * off / (wide_chips * wide_chips));
    double narrow = (1 - expected->slips) / (sqrt(2 * pi) * width) * exp(-0.5 * off * off / (width * width));

    return -log(wide + narrow);
}

/* Probability that it is another one than the chosen one. */
static double other(const double *cost, size_t count, size_t chosen)
{
    double odds = 0;

    for (size_t c = 0; c < count; c++) {
        double closer = cost[chosen] - cost[c];
        odds += closer < -700 ? 0 : exp(closer < 700 ? closer : 700); /* exp is slow where it gives 0 */
    }
    return 1 - 1 / odds;
}

static double square(double value)
{
    return value * value;
}

/* Where a candidate of the view begins. */
static double start_of(const struct gap_seen *seen, const struct judge_view *view, size_t candidate)
{
    return seen->fit.start + seen->fit.chip * ((double)candidate - (double)view->likely);
}

/* Negative log-probability of a start so far from a burst's first loud sample. */
static double cost_of_silence(double start, double first, double chip)
{
    return log1p(square((start - first) / (0.5 * chip)));
}

/* Weighs a carried frame against its rivals: whether it is the frame beyond doubt. */
static bool is_decided(const struct fit_code *code, const struct gap_rules *rules, const struct gap_expected *expected,
                       const struct judge_view *view, struct gap_seen *seen, float *scratch)
{
    const struct judge_words *words = &seen->words;
    const double chip = seen->fit.chip, power = *words->power > 1e-30f ? (double)*words->power : 1e-30;
    const size_t likely = view->likely;
    double cost[JUDGE_MOST], margin = rules->ruled_out;
    struct judge_votes votes;
    bool decided = false;

    if (!((double)*words->misfit < rules->carried_noise * view->noise / power + rules->carried_misfit))
        return false;
    seen->unaided = false;
    /* Mostly the least that the others cost is enough. */
    for (double close = margin / 2; !(decided && seen->unaided) && close <= margin; close *= 2) {
        if (!judge_weigh(code, &rules->judge, view, words, close, margin, &votes, cost, scratch))
            return false;
        double least = cost[likely];
        double most = judge_most(&rules->judge, rules->disturbed, &votes, view->count - 1 + code->span);
        for (size_t c = 0; c < view->count; c++) {
            if (c != likely && cost[c] < least + margin / 2)
                return false; /* with timing of its own it may get closer */
            cost[c] += cost_of_silence(start_of(seen, view, c), seen->burst.first, chip);
        }
        if (!(cost[likely] < most))
            return false;
        seen->unaided = other(cost, view->count, likely) < rules->doubt;
        for (size_t c = 0; c < view->count; c++)
            cost[c] += cost_of_place(expected, rules->wide, start_of(seen, view, c));
        decided = other(cost, view->count, likely) < rules->doubt;
    }
    return decided;
}

/* As WordFit.believable, of words that are even, by all of them and this noise of a chip's level. */
static bool are_sound(const struct words_frame *frame, const struct gap_rules *rules,
                      const struct judge_words *words, double noise)
{
    double power = (double)*words->power, pedestal = (double)*words->pedestal, active = 0;
    double even = power - pedestal * pedestal, spread = (double)*words->spread;

    for (size_t i = 0; i < frame->nodes; i++)
        active += words->amplitude[i] > 0;
    if (!(noise > 0 && even > 0 && active > 0 && spread <= rules->uneven))
        return false;
    double scatter = sqrt(2 / (active * (double)(frame->bits - 1)));
    double expected = noise * active / (double)frame->order / even * (1.3 + 4 * scatter);
    return spread < rules->spread * (1.7 - 0.7 / active) && spread < rules->spread / 2 + expected &&
           (double)*words->misfit < rules->left * noise / power + rules->misfit;
}

/* Size of the mean level beside a frame, without the sample that is farthest off: an impulse is a single one. */
static double level_beside(const struct fit_line *line, double first, double end, double level)
{
    double sum = 0, low = INFINITY, high = -INFINITY;
    size_t begin = first > 0 ? (size_t)ceil(first) : 0, stop = end > 0 ? (size_t)ceil(end) : 0;

    stop = stop < line->size ? stop : line->size;
    if (stop < begin + 2)
        return 0;
    for (size_t i = begin; i < stop; i++) {
        double volt = line->volts[i] - level;
        sum += volt;
        low = volt < low ? volt : low;
        high = volt > high ? volt : high;
    }
    low = fabs(sum - low);
    high = fabs(sum - high);
    return (low < high ? low : high) / (double)(stop - begin - 1);
}

/* Whether a word has the same bit throughout, or changes it once. */
static bool has_equal_bits(const struct words_frame *frame, const struct judge_words *words)
{
    for (size_t i = 0; i < frame->nodes; i++) {
        const float *row = words->rows + frame->first + i;
        size_t changes = 0;
        for (size_t bit = 1; bit < frame->bits; bit++)
            changes += (row[bit * frame->order] > 0) != (row[(bit - 1) * frame->order] > 0);
        if (words->amplitude[i] > 0 && changes <= 1)
            return true;
    }
    return false;
}

/* As `strays` in framing/gaps/stray.py, where it finds nothing without a closer look. least: amplitude of a node, V. */
static bool are_in_time(const struct fit_code *code, const struct gap_rules *rules, const struct fit_line *line,
                        double least, const struct gap_seen *seen)
{
    const struct words_frame *frame = &code->frame;
    double start = seen->fit.start, chip = seen->fit.chip, end = start + (double)code->span * chip;
    double noise = seen->beside.noise > 1e-30 ? seen->beside.noise : 1e-30, power = (double)*seen->words.power;
    double deviation = rules->perhaps * sqrt(noise / chip), most = rules->beside * least;
    double left = (double)*seen->words.misfit * power, level = line->level + seen->beside.level;

    most = most > deviation ? most : deviation;
    if (level_beside(line, start - rules->far * chip, start - rules->near * chip, level) > most ||
        level_beside(line, end + rules->near * chip, end + rules->far * chip, level) > most)
        return false;
    left -= noise / chip * (1 + rules->scatter * sqrt(2 / (double)(frame->bits * frame->order)));
    if (rules->twins && (left > rules->stray_left * least * least / (double)frame->order ||
                         (noise / chip > square(rules->clear * least) && has_equal_bits(frame, &seen->words))))
        return false;
    size_t count = code->span < rules->most_turned ? code->span : rules->most_turned;
    double by_noise = 2 * noise / (rules->inner * chip);
    return fit_turned(line, &seen->fit, rules->inner, rules->blur, count) <=
           rules->turned * least * least + by_noise * (1 + rules->scatter * sqrt(2 / (double)count));
}

/* Whether there may be a weaker burst before this one, as GapTiming._first_burst asks. */
static bool may_have_another(const struct burst_search *search, const struct gap_rules *rules,
                             const struct burst_found *burst, size_t size)
{
    double before = burst->pause < burst->last
                        ? floor(burst->pause) + ceil(rules->bit)
                        : floor(burst->first - search->chip);

    return rules->shortest < before && before < (double)size;
}

/* Finds the chips in view of the frame that `fit` says and its rivals, and its words. False where there are too many
 * rivals, or silence after them is not in view yet; see find_shifts. */
static bool view_frame(const struct fit_code *code, const struct gap_rules *rules, const struct fit_line *line,
                       struct gap_seen *seen, struct judge_view *view, float *levels)
{
    double earliest, latest;

    if (!find_shifts(code, rules, line->size, seen, &earliest, &latest))
        return false;
    view->likely = (size_t)-earliest;
    view->count = view->likely + 1 + (size_t)latest;
    fit_levels(line, &seen->fit, rules->blur, view->likely, code->span + view->count - 1, levels);
    read_words(code, levels + view->likely, &seen->words);
    return true;
}

/* As GapSearch.carried, with the words of the frame that it finds. */
static bool carry(const struct fit_code *code, const struct gap_rules *rules, const struct fit_refining *refining,
                  const struct gap_expected *expected, const struct fit_line *line, struct gap_seen *seen,
                  struct judge_view *view, float *levels, float *scratch)
{
    seen->fit = (struct fit){expected->start, expected->chip};
    if (view_frame(code, rules, line, seen, view, levels) && (double)*seen->words.misfit < rules->still_misfit)
        return true;
    seen->fit = fit_refine(code, line, refining, seen->fit, -INFINITY, INFINITY, scratch);
    seen->proven = 0;
    return seen->fit.chip > rules->least_chip * expected->chip && view_frame(code, rules, line, seen, view, levels);
}

/* Whether a burst may be the frame that is expected, and begins after a gap. */
static bool may_be_it(const struct fit_code *code, const struct burst_search *search, const struct gap_rules *rules,
                      const struct gap_expected *expected, const struct burst_found *burst)
{
    double loud = burst->last - burst->first, least = rules->shortest - 1.5 * (double)code->frame.order * search->chip;

    return expected->chip > 0 && burst->first >= search->chip &&
           fabs(burst->first - expected->start) < rules->period / 2 && loud + 2 * burst->slack >= least &&
           loud <= rules->longest + 2 * burst->slack;
}

/* Share of a frame's samples that are at a rail. */
VECTORS static double share_clipped(const struct gap_rules *rules, const double *raw, size_t size, double start,
                                    double end)
{
    size_t begin = start > 0 ? (size_t)rint(start) : 0, stop = (size_t)rint(end), count = 0;

    stop = stop < size ? stop : size;
    for (size_t i = begin; i < stop; i++)
        count += (size_t)(raw[i] <= rules->rail_low) | (size_t)(raw[i] >= rules->rail_high);
    return stop > begin ? (double)count / (double)(stop - begin) : 0;
}

bool gap_look(const struct fit_code *code, const struct burst_search *search, const struct gap_rules *rules,
              const struct fit_refining *refining, const double *volts, const double *raw, size_t size,
              double least_power, const struct burst_gap *known, const struct gap_expected *expected,
              struct gap_seen *seen, enum gap_look *look, double *values, float *scratch)
{
    size_t halves = size / search->half;
    double *means = values, *rest = means + halves, *sums = values; /* sums once the burst is found */
    double behind = 0; /* the last half chip */
    struct burst_found *burst = &seen->burst;
    float *levels = scratch;

    *look = GAP_SILENT;
    seen->proven = 0;
    seen->sound = false;
    burst_halves(search, volts, size, means);
    for (size_t i = halves * search->half; i < size; i++)
        behind += volts[i];
    if (isnan(behind) || !burst_gap(search, means, halves, known, &seen->gap, rest))
        return false;
    if (!burst_find(search, means, halves, least_power, &seen->gap, burst, rest))
        return true;
    *look = GAP_UNSURE;
    if (may_have_another(search, rules, burst, size))
        return true;
    *look = GAP_BURST;
    if (!may_be_it(code, search, rules, expected, burst))
        return true;
    const struct fit_line line = {size, volts, sums, seen->gap.level};
    struct judge_view view = {.levels = levels};
    fit_sums(volts, size, line.level, sums);
    scratch += code->span + JUDGE_MOST;
    if (!carry(code, rules, refining, expected, &line, seen, &view, levels, scratch))
        return true;
    view.noise = burst->variance * (double)search->half / seen->fit.chip;
    if (!is_decided(code, rules, expected, &view, seen, scratch))
        return true;
    double end = seen->fit.start + (double)code->span * seen->fit.chip;
    double before = floor(seen->fit.start - seen->fit.chip), behind_it = ceil(end + seen->fit.chip);
    seen->beside = burst_beside(search, volts, size, line.level, before > 0 ? (size_t)before : 0, (size_t)behind_it,
                                burst->variance, burst->power, scratch);
    double noise = seen->beside.variance * (double)search->half / seen->fit.chip;
    seen->clipped = share_clipped(rules, raw, size, seen->fit.start, end);
    seen->sound = seen->clipped <= rules->deafened && seen->beside.quiet &&
                  are_sound(&code->frame, rules, &seen->words, noise) &&
                  are_in_time(code, rules, &line, sqrt(least_power) / rules->faint, seen);
    seen->noise = words_noise(&code->frame, seen->words.rows, rules->spare, rules->spare_count);
    *look = GAP_FRAME;
    return true;
}
