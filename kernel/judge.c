// SPDX-License-Identifier: Apache-2.0

#include "judge.h"

#include <math.h>
#include <string.h>

#define LANES 16 /* sums that are kept apart, so that they can be added at once */
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
              (all->end - all->begin) / chip < 1e6))
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

static double square_sum(const float *values, size_t size)
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

/* Power that a candidate's words leave in its rows, V²·bits. */
static double left_in_rows(const struct fit_code *code, const float *rows, const float *amplitude,
                           float pedestal)
{
    const struct words_frame *frame = &code->frame;
    double left = 0;

    for (size_t bit = 0; bit < frame->bits; bit++, rows += frame->order) {
        const float *levels = rows + frame->first;
        size_t after = frame->first + frame->nodes;
        float partial[LANES] = {0};
        size_t node = 0;
        for (; node + LANES <= frame->nodes; node += LANES)
            for (size_t lane = 0; lane < LANES; lane++) {
                float off = fabsf(levels[node + lane]) - amplitude[node + lane];
                partial[lane] += off * off;
            }
        for (; node < frame->nodes; node++) {
            float off = fabsf(levels[node]) - amplitude[node];
            partial[0] += off * off;
        }
        for (size_t lane = 0; lane < LANES; lane++)
            left += (double)partial[lane];
        for (size_t i = 0; i < frame->first; i++) {
            double off = (double)(rows[i] - (i ? 0 : pedestal));
            left += off * off;
        }
        left += square_sum(rows + after, frame->order - after);
    }
    return left;
}

/* Copies the view's levels that no coded chip has: beside the frame, and guards in it. */
static size_t copy_silent(const struct fit_code *code, const struct seen *seen, const float *levels,
                          float *silent)
{
    size_t chips = code->frame.bits * code->frame.order, count = 0, end = seen->lead + code->span;

    for (size_t i = 0; i < seen->lead; i++)
        silent[count++] = levels[i];
    for (size_t i = 0, next = 0; code->span > chips && i < code->span; i++)
        if (next < chips && (size_t)code->places[next] == i)
            next++;
        else
            silent[count++] = levels[seen->lead + i];
    for (size_t i = end; i < seen->count; i++)
        silent[count++] = levels[i];
    return count;
}

/* Sum of the chips' votes, which replace what is off in them. */
static double votes_of(float *off, size_t size, const struct judge_votes *votes, double most)
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

/* What a candidate's words leave of each chip of its view. model: (k, N) for scratch. */
static void find_off(const struct fit_code *code, const struct seen *seen, const float *levels,
                     const float *rows, const float *amplitude, float pedestal, float *off,
                     float *model)
{
    size_t size = code->frame.bits * code->frame.order;

    memcpy(off, levels, seen->count * sizeof *off);
    fit_model(code, rows, amplitude, pedestal, model);
    off += seen->lead;
    for (size_t i = 0; code->span == size && i < size; i++)
        off[i] -= model[i];
    for (size_t i = 0; code->span != size && i < size; i++)
        off[code->places[i]] -= model[i];
}

/* Those of a line on which even the best candidate leaves `off` over; see _Votes.of in judge.py. */
static struct judge_votes votes_by(const struct judge_limits *limits, const float *levels, float *off,
                                   size_t count, double noise)
{
    double squares = 0;
    float partial[LANES] = {0};
    size_t rank = (size_t)(limits->most * (double)(count - 1)), within = 0;

    for (size_t i = 0; i + 1 < count; i++) {
        float step = levels[i + 1] - levels[i];
        partial[i % LANES] += step * step;
    }
    for (size_t lane = 0; lane < LANES; lane++)
        squares += (double)partial[lane];
    double distortion = limits->distortion * sqrt(0.5 * squares / (double)(count - 1));
    double variance = 0.25 * distortion * distortion;
    variance = noise > variance ? noise : variance;
    variance = variance > 1e-30 ? variance : 1e-30;
    float most = (float)(limits->most_deviations * sqrt(variance));
    for (size_t i = 0; i < count; i++)
        within += fabsf(off[i]) <= most;
    if (within <= rank) {
        for (size_t i = 0; i < count; i++)
            off[i] = fabsf(off[i]);
        double left = (double)fit_ranked(off, (ptrdiff_t)count, (ptrdiff_t)rank) / limits->most_deviations;
        variance = left * left > variance ? left * left : variance;
    }
    return (struct judge_votes){distortion, variance};
}

void judge_weigh(const struct fit_code *code, const struct fit_line *line,
                 const struct judge_limits *limits, const struct judge_candidates *all, double noise,
                 const struct judge_found *found, struct judge_votes *votes, float *scratch)
{
    const struct words_frame *frame = &code->frame;
    size_t size = frame->bits * frame->order, nodes = frame->nodes, chips = judge_chips(code, all);
    size_t best = 0;
    float *levels = scratch, *off = levels + chips, *model = off + chips;
    struct seen there = {.count = 0};

    for (size_t c = 0; c < all->count; c++) {
        struct seen seen = seen_of(code, all, c);
        float *rows = found->rows + c * size, *amplitude = found->amplitude + c * nodes;
        find_levels(line, limits->blur, &seen, &there, levels);
        fit_rows(code, levels + seen.lead, rows);
        words_fit(frame, rows, amplitude, found->uneven + c * nodes, &found->pedestal[c],
                  &found->power[c], &found->spread[c], &found->misfit[c]);
        double left = (double)frame->order * left_in_rows(code, rows, amplitude, found->pedestal[c]);
        left += square_sum(off, copy_silent(code, &seen, levels, off));
        found->cost[c] = seen.weight * left;
        best = found->cost[c] < found->cost[best] ? c : best;
    }
    for (size_t turn = 0; turn < all->count; turn++) { /* the best one first */
        size_t c = turn == 0 ? best : turn == best ? 0 : turn;
        struct seen seen = seen_of(code, all, c);
        find_levels(line, limits->blur, &seen, &there, levels);
        find_off(code, &seen, levels, found->rows + c * size, found->amplitude + c * nodes,
                 found->pedestal[c], off, model);
        if (!(votes->variance > 0))
            *votes = votes_by(limits, levels, off, seen.count, noise);
        found->cost[c] = seen.weight * votes_of(off, seen.count, votes, limits->vote);
    }
}
