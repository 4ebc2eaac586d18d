// SPDX-License-Identifier: Apache-2.0

#include "judge.h"

#include <math.h>
#include <stdbool.h>
#include <string.h>

#include "vectors.h"

#define LANES 16 /* sums that are kept apart, so that they can be added at once */
#define MOST_CHIPS (1 << 25) /* of a view: more than any frame has */
#define RULING_CHIPS 1000
#define SAME 1e-9 /* chips: starts that are as close to whole chips apart are on one lattice */

/* One candidate in the view: `lead` chips before its frame, `count` in all. */
struct seen {
    struct fit fit;
    size_t lead, count;
    double weight; /* of a chip: its duration, relative to the others' */
};

static struct seen seen_of(const struct fit_code *code, const struct judge_candidates *all, size_t number)
{
    double start = all->start[number], chip = all->chip[number], sum = 0;
    double end = start + (double)code->span * chip;

    for (size_t i = 0; i < all->count; i++)
        sum += all->chip[i];
    size_t lead = (size_t)rint((start - all->begin) / chip);
    size_t after = (size_t)rint((all->end - end) / chip);
    return (struct seen){{start, chip}, lead, lead + code->span + after, chip / (sum / (double)all->count)};
}

size_t judge_chips(const struct fit_code *code, const struct judge_candidates *all)
{
    size_t most = 0;

    for (size_t i = 0; i < all->count; i++) {
        double chip = all->chip[i], end = all->start[i] + (double)code->span * chip;
        if (!(chip > 0 && all->start[i] >= all->begin - 0.5 * chip && end <= all->end + 0.5 * chip &&
              (all->end - all->begin) / chip < MOST_CHIPS))
            return 0;
        size_t count = seen_of(code, all, i).count;
        most = count > most ? count : most;
    }
    return most;
}

/* The levels of a candidate's view, unless those that are there are of the same chips. */
static void find_levels(const struct fit_line *line, double blur, const struct seen *seen,
                        struct seen *there, float *levels)
{
    double apart = (seen->fit.start - there->fit.start) / seen->fit.chip;

    if (there->count == seen->count && there->fit.chip == seen->fit.chip &&
        fabs(apart - ((double)seen->lead - (double)there->lead)) < SAME)
        return;
    fit_levels(line, &seen->fit, blur, seen->lead, seen->count, levels);
    *there = *seen;
}

VECTORS static double square_sum(const float *values, size_t size)
{
    float partial[LANES] = {0};
    double sum = 0;
    size_t i = 0;

    for (; i + LANES <= size; i += LANES)
        for (size_t lane = 0; lane < LANES; lane++)
            partial[lane] += values[i + lane] * values[i + lane];
    for (; i < size; i++)
        partial[0] += values[i] * values[i];
    for (size_t lane = 0; lane < LANES; lane++)
        sum += (double)partial[lane];
    return sum;
}

/* Sum of the chips' votes, which replace what is off in them. */
VECTORS static double votes_of(float *off, size_t size, const struct judge_votes *votes, double most)
{
    const float distortion = (float)votes->distortion, scale = (float)(0.5 / votes->variance);
    const float limit = (float)most;
    float partial[LANES] = {0};
    double sum = 0;
    size_t i = 0;

    for (size_t chip = 0; chip < size; chip++) {
        float beyond = fabsf(off[chip]) - distortion;
        beyond = beyond > 0 ? beyond : 0;
        beyond = beyond * beyond * scale;
        off[chip] = beyond < limit ? beyond : limit;
    }
    for (; i + LANES <= size; i += LANES)
        for (size_t lane = 0; lane < LANES; lane++)
            partial[lane] += off[i + lane];
    for (; i < size; i++)
        partial[0] += off[i];
    for (size_t lane = 0; lane < LANES; lane++)
        sum += (double)partial[lane];
    return sum;
}

/* Those of a line on which even the best candidate leaves `off` over; see _Votes.of in judge.py. */
VECTORS static struct judge_votes votes_by(const struct judge_limits *limits, const float *levels, float *off,
                                   size_t count, double noise)
{
    double squares = 0;
    float partial[LANES] = {0};
    size_t rank = (size_t)(limits->most * (double)(count - 1)), next = 0;
    int32_t within = 0;

    for (; next + LANES < count; next += LANES)
        for (size_t lane = 0; lane < LANES; lane++) {
            float step = levels[next + lane + 1] - levels[next + lane];
            partial[lane] += step * step;
        }
    for (; next + 1 < count; next++)
        partial[0] += (levels[next + 1] - levels[next]) * (levels[next + 1] - levels[next]);
    for (size_t lane = 0; lane < LANES; lane++)
        squares += (double)partial[lane];
    double distortion = limits->distortion * sqrt(0.5 * squares / (double)(count - 1));
    double variance = 0.25 * distortion * distortion;
    variance = noise > variance ? noise : variance;
    variance = variance > 1e-30 ? variance : 1e-30;
    float most = (float)(limits->most_deviations * sqrt(variance));
    for (size_t i = 0; i < count; i++)
        within += fabsf(off[i]) <= most;
    if ((size_t)within <= rank) {
        for (size_t i = 0; i < count; i++)
            off[i] = fabsf(off[i]);
        double left = (double)fit_ranked(off, (ptrdiff_t)count, (ptrdiff_t)rank) / limits->most_deviations;
        variance = left * left > variance ? left * left : variance;
    }
    return (struct judge_votes){distortion, variance};
}

/* What all functions below work with. off: (c, most) what candidates leave of the chips of their views. model:
 * chips that they say were sent, on end. */
struct weighing {
    const struct fit_code *code;
    const struct fit_line *line;
    const struct judge_limits *limits;
    const struct judge_candidates *all;
    const struct judge_found *found;
    struct judge_votes *votes;
    struct seen there; /* whose `levels` these are */
    size_t most;
    float *levels, *off, *model;
    double noise;
};

size_t judge_scratch(const struct fit_code *code, const struct judge_candidates *all)
{
    return (all->count + 2) * judge_chips(code, all) + all->count * code->frame.bits * code->frame.order;
}

static struct seen look_at(struct weighing *w, size_t c)
{
    struct seen seen = seen_of(w->code, w->all, c);

    find_levels(w->line, w->limits->blur, &seen, &w->there, w->levels);
    return seen;
}

/* The last bits of a frame alone. Not the first ones, in which words are more alike. */
static struct fit_code last_of(const struct fit_code *code, size_t bits)
{
    size_t before = (code->frame.bits - bits) * code->frame.order;
    struct fit_code last = *code;

    last.frame.bits = bits;
    last.places += before;
    last.flips = code->flips ? code->flips + before : NULL;
    return last;
}

/* Candidate number `i` of those from `first` to before `end`, the `whole` one last. */
static size_t nth(size_t first, size_t end, size_t whole, size_t i)
{
    size_t c = first + i;

    if (whole < first || whole >= end)
        return c;
    return c == end - 1 ? whole : c + (c >= whole);
}

/* Finds the words of the candidates from `first` to before `end`, and the models, on end: by the last bits of all but
 * the one that is `whole`, which comes last, unless its words are known. What transforms do at once costs little more
 * than one of them. */
static void find_words(struct weighing *w, size_t first, size_t end, size_t whole, size_t bits)
{
    const struct judge_found *found = w->found;
    const size_t order = w->code->frame.order, size = w->code->frame.bits * order, nodes = w->code->frame.nodes;
    const struct fit_code last = last_of(w->code, bits);
    const bool known = w->all->levels && whole == w->all->likely;
    float *model = w->model;

    for (size_t i = 0; i < end - first - known; i++) {
        size_t c = nth(first, end, whole, i);
        const struct fit_code *code = c == whole ? w->code : &last;
        struct seen seen = look_at(w, c);
        fit_chips(code, w->levels + seen.lead, code->frame.bits, model);
        model += code->frame.bits * order;
    }
    transform_multiply(w->code->correlate, w->model, w->model, (size_t)(model - w->model) / order);
    model = w->model;
    for (size_t i = 0; i < end - first; i++) {
        size_t c = nth(first, end, whole, i);
        const struct words_frame *frame = c == whole ? &w->code->frame : &last.frame;
        float *rows = found->rows + c * size, *amplitude = found->amplitude + c * nodes;
        if (!(known && c == whole)) {
            memcpy(rows, model, frame->bits * order * sizeof *rows);
            words_fit(frame, rows, amplitude, found->uneven + c * nodes, &found->pedestal[c], &found->power[c],
                      &found->spread[c], frame->bits < w->code->frame.bits ? NULL : &found->misfit[c]);
        }
        fit_symbols(w->code, frame->bits, rows, amplitude, model);
        model += frame->bits * order;
    }
    transform_multiply(w->code->spread, w->model, w->model, (size_t)(model - w->model) / order);
    model = w->model;
    for (size_t i = 0; i < end - first; i++) {
        size_t c = nth(first, end, whole, i);
        const struct fit_code *code = c == whole ? w->code : &last;
        fit_model(code, code->frame.bits, found->pedestal[c], model);
        model += code->frame.bits * order;
    }
}

/* Finds what the model's chips of the last bits leave of the levels of a candidate's view, and what is silent
 * in that. Returns how many they are. */
VECTORS static size_t find_off(struct weighing *w, size_t c, size_t bits, const float *model)
{
    const struct fit_code code = last_of(w->code, bits);
    struct seen seen = look_at(w, c);
    size_t chips = bits * code.frame.order;
    ptrdiff_t before = bits < w->code->frame.bits ? code.places[0] : 0; /* chips of the frame */
    float *off = w->off + c * w->most, *own = off + seen.lead;

    memcpy(off, w->levels, seen.lead * sizeof *off);
    memcpy(own, w->levels + seen.lead + before, (seen.count - seen.lead - (size_t)before) * sizeof *off);
    if (code.span == w->code->frame.bits * code.frame.order)
        for (size_t i = 0; i < chips; i++)
            own[i] -= model[i];
    else
        for (size_t i = 0; i < chips; i++)
            own[code.places[i] - before] -= model[i];
    return seen.count - (size_t)before;
}

/* The power of what a candidate leaves over. */
static double left_by(const struct weighing *w, size_t c, size_t size)
{
    return seen_of(w->code, w->all, c).weight * square_sum(w->off + c * w->most, size);
}

/* Finds how chips vote by what a candidate leaves over, unless that is known. */
static void find_votes(struct weighing *w, size_t c)
{
    struct seen seen = look_at(w, c);

    if (!(w->votes->variance > 0)) {
        float *copy = w->off + w->all->count * w->most; /* whose order changes */
        memcpy(copy, w->off + c * w->most, seen.count * sizeof *copy);
        *w->votes = votes_by(w->limits, w->levels, copy, seen.count, w->noise);
    }
}

/* The cost of a candidate by what it leaves over. */
static double cost_of(const struct weighing *w, size_t c, size_t size)
{
    double weight = seen_of(w->code, w->all, c).weight;

    return weight * votes_of(w->off + c * w->most, size, w->votes, w->limits->vote);
}

/* Bits that rule candidates out: what is wrong by whole chips is wrong in all. Chosen: of about so many chips,
 * but half of the bits at most. */
static size_t first_bits(const struct words_frame *frame)
{
    size_t half = (frame->bits + 1) / 2, bits = RULING_CHIPS / frame->order + 1;

    bits = bits < half ? bits : half;
    return bits < 2 ? 2 : bits;
}

/* Weighs the likely candidate, and of the others those that their last bits do not rule out. False where
 * one of them leaves less over than the likely one does: then it is the one by which chips vote. */
static bool weigh_likely(struct weighing *w)
{
    const size_t likely = w->all->likely, count = w->all->count, all = w->code->frame.bits;
    const size_t bits = first_bits(&w->code->frame), part = bits * w->code->frame.order;
    double *cost = w->found->cost;
    /* whether they leave more over than the likely one, until their words are known */
    float *more = w->found->misfit;

    find_words(w, 0, count, likely, bits);
    size_t size = find_off(w, likely, all, w->model + (count - 1) * part);
    double left = left_by(w, likely, size);
    find_votes(w, likely);
    double least = cost[likely] = cost_of(w, likely, size);
    const float *model = w->model;
    for (size_t c = 0; c < count; c++) {
        if (c != likely) {
            size = find_off(w, c, bits, model);
            more[c] = (float)left_by(w, c, size) > (float)left;
            cost[c] = cost_of(w, c, size);
            model += part;
        }
    }
    for (size_t c = 0; c < count; c++) {
        if (c == likely || cost[c] > least + (more[c] > 0 ? w->all->close : w->all->margin))
            continue;
        find_words(w, c, c + 1, c, all);
        size = find_off(w, c, all, w->model);
        if (left_by(w, c, size) < left)
            return false;
        cost[c] = cost_of(w, c, size);
    }
    return true;
}

static void weigh_all(struct weighing *w)
{
    const size_t count = w->all->count, all = w->code->frame.bits;
    double *cost = w->found->cost;
    size_t best = 0;

    find_words(w, 0, count, count, all);
    for (size_t c = 0; c < count; c++) {
        cost[c] = left_by(w, c, find_off(w, c, all, w->model + c * all * w->code->frame.order));
        best = cost[c] < cost[best] ? c : best;
    }
    find_votes(w, best);
    for (size_t c = 0; c < count; c++)
        cost[c] = cost_of(w, c, seen_of(w->code, w->all, c).count);
}

void judge_weigh(const struct fit_code *code, const struct fit_line *line,
                 const struct judge_limits *limits, const struct judge_candidates *all, double noise,
                 const struct judge_found *found, struct judge_votes *votes, float *scratch)
{
    size_t most = judge_chips(code, all);
    struct judge_votes given = *votes;
    struct weighing w = {.code = code, .line = line, .limits = limits, .all = all, .found = found,
                         .votes = votes, .noise = noise, .most = most, .levels = scratch,
                         .off = scratch + most, .model = scratch + (all->count + 2) * most};

    if (all->levels) {
        w.levels = all->levels;
        w.there = seen_of(code, all, all->likely);
    }
    if (all->likely < all->count && weigh_likely(&w))
        return;
    *votes = given;
    weigh_all(&w);
}

double judge_most(const struct judge_limits *limits, double disturbed, const struct judge_votes *votes,
                  size_t chips)
{
    double d = votes->distortion / sqrt(votes->variance), count = (double)chips;
    double density = exp(-0.5 * d * d) / sqrt(2 * 3.14159265358979323846);
    double usual = count * ((1 + d * d) * 0.5 * erfc(d / sqrt(2)) - d * density);

    return usual + 5 * sqrt(usual) + disturbed * count * limits->vote;
}
