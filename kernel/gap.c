// SPDX-License-Identifier: Apache-2.0

#include "gap.h"

#include <math.h>
#include <string.h>

size_t gap_values(const struct burst_search *search, size_t samples)
{
    size_t halves = samples / search->half;

    return samples + 1 + halves + burst_scratch(halves);
}

/* Chips of the longest view of GAP_MOST candidates a chip apart. */
static size_t most_chips(const struct fit_code *code)
{
    return code->span + GAP_MOST;
}

size_t gap_scratch(const struct fit_code *code, const struct burst_search *search)
{
    size_t order = code->frame.order, each = code->frame.bits * order + 2 * code->frame.nodes + 4;
    size_t judge = (GAP_MOST + 2) * most_chips(code) + GAP_MOST * code->frame.bits * order;
    size_t beside = 4 * (search->gap_size / search->half + 1), refine = fit_scratch(code);

    judge = judge < beside ? beside : judge;
    return most_chips(code) + GAP_MOST * each + (judge < refine ? refine : judge);
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
    return seen->proven > 0 && seen->proven <= (double)size && *latest - *earliest < GAP_MOST;
}

/* As GapSearch.carried: whether the chips where a frame is expected leave nothing over, and then its words. levels: of
 * the chips in view, too. */
static bool is_still(const struct fit_code *code, const struct fit_line *line, double blur, double misfit,
                     double earliest, double latest, struct gap_seen *seen, float *levels)
{
    const struct judge_found *words = &seen->words;
    size_t lead = (size_t)-earliest;

    fit_levels(line, &seen->fit, blur, lead, lead + code->span + (size_t)latest, levels);
    fit_chips(code, levels + lead, code->frame.bits, words->rows);
    transform_multiply(code->correlate, words->rows, words->rows, code->frame.bits);
    words_fit(&code->frame, words->rows, words->amplitude, words->uneven, words->pedestal, words->power, words->spread,
              words->misfit);
    return (double)*words->misfit < misfit;
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

static void copy_words(const struct words_frame *frame, const struct judge_found *from, const struct judge_found *to)
{
    memcpy(to->rows, from->rows, frame->bits * frame->order * sizeof *to->rows);
    memcpy(to->amplitude, from->amplitude, frame->nodes * sizeof *to->amplitude);
    memcpy(to->uneven, from->uneven, frame->nodes * sizeof *to->uneven);
    *to->pedestal = *from->pedestal;
    *to->power = *from->power;
    *to->spread = *from->spread;
    *to->misfit = *from->misfit;
}

/* Weighs a carried frame against its rivals. Returns whether it is the frame beyond doubt, and then its words. levels:
 * as in judge_candidates. */
static bool judge(const struct fit_code *code, const struct fit_line *line, const struct judge_limits *limits,
                  const struct gap_rules *rules, const struct gap_expected *expected, double noise,
                  double earliest, double latest, float *levels, struct gap_seen *seen, float *scratch)
{
    const struct words_frame *frame = &code->frame;
    size_t size = frame->bits * frame->order, nodes = frame->nodes, count = (size_t)(latest - earliest) + 1;
    size_t likely = (size_t)-earliest;
    double start[GAP_MOST], chip[GAP_MOST], cost[GAP_MOST];
    float *rows = scratch, *amplitude = rows + GAP_MOST * size, *uneven = amplitude + GAP_MOST * nodes;
    float *four = uneven + GAP_MOST * nodes;
    struct judge_found found = {rows, amplitude, uneven, four, four + GAP_MOST, four + 2 * GAP_MOST,
                                four + 3 * GAP_MOST, cost};
    const struct judge_found own = {rows + likely * size, amplitude + likely * nodes, uneven + likely * nodes,
                                    four + likely, four + GAP_MOST + likely, four + 2 * GAP_MOST + likely,
                                    four + 3 * GAP_MOST + likely, NULL};
    struct judge_votes votes;

    if (levels)
        copy_words(frame, &seen->words, &own);
    for (size_t c = 0; c < count; c++) {
        start[c] = seen->fit.start + seen->fit.chip * ((double)c + earliest);
        chip[c] = seen->fit.chip;
    }
    struct judge_candidates all = {count, likely, start, chip, start[0],
                                   start[count - 1] + (double)code->span * chip[0], rules->ruled_out,
                                   rules->ruled_out / 2, levels};
    bool decided = false;
    seen->unaided = false;
    /* Mostly the least that the others cost is enough. */
    for (; !(decided && seen->unaided) && all.close <= all.margin; all.close *= 2) {
        votes = (struct judge_votes){0, 0};
        judge_weigh(code, line, limits, &all, noise, &found, &votes, four + 4 * GAP_MOST);
        double power = *own.power > 1e-30f ? (double)*own.power : 1e-30;
        double most = judge_most(limits, rules->disturbed, &votes, count - 1 + code->span), least = cost[likely];
        if (!((double)*own.misfit < rules->carried_noise * noise / power + rules->carried_misfit &&
              least + log1p(square((start[likely] - seen->burst.first) / (0.5 * chip[likely]))) < most))
            return false;
        for (size_t c = 0; c < count; c++) {
            if (c != likely && cost[c] < least + rules->ruled_out / 2)
                return false; /* with timing of its own it may get closer */
            cost[c] += log1p(square((start[c] - seen->burst.first) / (0.5 * chip[c])));
        }
        seen->unaided = other(cost, count, likely) < rules->doubt;
        for (size_t c = 0; c < count; c++)
            cost[c] += cost_of_place(expected, rules->wide, start[c]);
        decided = other(cost, count, likely) < rules->doubt;
    }
    if (!decided)
        return false;
    copy_words(frame, &own, &seen->words);
    return true;
}

/* As WordFit.believable, of words that are even, by all of them and this noise of a chip's level. */
static bool are_sound(const struct words_frame *frame, const struct gap_rules *rules,
                      const struct judge_found *words, double noise)
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
static bool has_equal_bits(const struct words_frame *frame, const struct judge_found *words)
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
                        double blur, double least, const struct gap_seen *seen)
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
    return fit_turned(line, &seen->fit, rules->inner, blur, count) <=
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

bool gap_look(const struct fit_code *code, const struct burst_search *search,
              const struct judge_limits *limits, const struct gap_rules *rules,
              const double *reaches, size_t turns, const double *volts, size_t size,
              double least_power, const struct burst_gap *known, const struct gap_expected *expected,
              struct gap_seen *seen, enum gap_look *look, double *values, float *scratch)
{
    size_t halves = size / search->half;
    double *sums = values, *means = sums + size + 1, *rest = means + halves, earliest, latest;
    double behind = 0; /* the last half chip */
    struct burst_found *burst = &seen->burst;

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
    double loud = burst->last - burst->first;
    if (!(expected->chip > 0 && burst->first >= search->chip &&
          fabs(burst->first - expected->start) < rules->period / 2 &&
          loud + 2 * burst->slack >= rules->shortest - 1.5 * (double)code->frame.order * search->chip &&
          loud <= rules->longest + 2 * burst->slack))
        return true;
    const struct fit_line line = {size, volts, sums, seen->gap.level};
    fit_sums(volts, size, line.level, sums);
    float *levels = scratch;
    scratch += most_chips(code);
    seen->fit = (struct fit){expected->start, expected->chip};
    if (!(find_shifts(code, rules, size, seen, &earliest, &latest) &&
          is_still(code, &line, limits->blur, rules->still_misfit, earliest, latest, seen, levels))) {
        const struct fit_refining refining = {limits->blur, rules->settled_chips, turns, reaches};
        seen->fit = fit_refine(code, &line, &refining, seen->fit, -INFINITY, INFINITY, scratch);
        seen->proven = 0;
        if (!(seen->fit.chip > rules->least_chip * expected->chip &&
              find_shifts(code, rules, size, seen, &earliest, &latest)))
            return true;
        levels = NULL;
    }
    double noise = burst->variance * (double)search->half / seen->fit.chip;
    if (!judge(code, &line, limits, rules, expected, noise, earliest, latest, levels, seen, scratch))
        return true;
    double first = floor(seen->fit.start - seen->fit.chip);
    double end = ceil(seen->fit.start + ((double)code->span + 1) * seen->fit.chip);
    seen->beside = burst_beside(search, volts, size, line.level, first > 0 ? (size_t)first : 0, (size_t)end,
                                burst->variance, burst->power, scratch);
    noise = seen->beside.variance * (double)search->half / seen->fit.chip;
    seen->sound = seen->beside.quiet && are_sound(&code->frame, rules, &seen->words, noise) &&
                  are_in_time(code, rules, &line, limits->blur, sqrt(least_power) / rules->faint, seen);
    seen->noise = words_noise(&code->frame, seen->words.rows, rules->spare, rules->spare_count);
    *look = GAP_FRAME;
    return true;
}
