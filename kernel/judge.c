// SPDX-License-Identifier: Apache-2.0

#include "judge.h"

#include <math.h>
#include <string.h>

#include "vectors.h"

#define LANES 16 /* sums that are kept apart, so that they can be added at once */
#define RULING_CHIPS 700

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

/* Those of a line on which even the best candidate leaves `off` over; see _votes_of in judge.py. */
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

/* Bits that rule rivals out: what is wrong by whole chips is wrong in all. Chosen: of about so many chips,
 * but half of the bits at most. */
static size_t ruling_bits(const struct words_frame *frame)
{
    size_t half = (frame->bits + 1) / 2, bits = RULING_CHIPS / frame->order + 1;

    bits = bits < half ? bits : half;
    return bits < 2 ? 2 : bits;
}

/* Replaces what rows hold, of so many frames or parts of them, by the line's chips. */
static void spread_out(const struct fit_code *code, size_t count, const float *pedestal, float *rows)
{
    const size_t bits = code->frame.bits, size = bits * code->frame.order;

    transform_multiply(code->spread, rows, rows, count * bits);
    for (size_t i = 0; i < count; i++)
        fit_model(code, bits, pedestal[i], rows + i * size);
}

/* Replaces chips, of so many frames or parts of them, by those that their words mean. */
static void find_models(const struct fit_code *code, size_t count, float *chips, float *scratch)
{
    const struct words_frame *frame = &code->frame;
    const size_t size = frame->bits * frame->order;
    float *rows = scratch, *amplitude = rows + size, *uneven = amplitude + frame->nodes, pedestal[JUDGE_MOST];

    transform_multiply(code->correlate, chips, chips, count * frame->bits);
    for (size_t i = 0; i < count; i++) {
        memcpy(rows, chips + i * size, size * sizeof *rows);
        words_fit(frame, rows, amplitude, uneven, &pedestal[i], NULL, NULL, NULL);
        fit_symbols(code, frame->bits, rows, amplitude, chips + i * size);
    }
    spread_out(code, count, pedestal, chips);
}

/* Finds what the model of candidate `c`, of its whole frame or of the last bits, leaves of the levels in view, from
 * these bits on, and what is silent before the frame. Returns how many levels they are. */
VECTORS static size_t find_off(const struct fit_code *code, const struct judge_view *view, size_t c, const float *model,
                               float *off)
{
    const size_t chips = code->frame.bits * code->frame.order, first = (size_t)code->places[0];
    const size_t rest = code->span - first + view->count - 1 - c;
    float *own = off + c;

    memcpy(off, view->levels, c * sizeof *off);
    memcpy(own, view->levels + c + first, rest * sizeof *own);
    if ((size_t)code->places[chips - 1] - first == chips - 1)
        for (size_t i = 0; i < chips; i++)
            own[i] -= model[i];
    else
        for (size_t i = 0; i < chips; i++)
            own[(size_t)code->places[i] - first] -= model[i];
    return c + rest;
}

size_t judge_scratch(const struct fit_code *code)
{
    const struct words_frame *frame = &code->frame;

    return (JUDGE_MOST + 2) * frame->bits * frame->order + 2 * frame->nodes + 2 * (code->span + JUDGE_MOST);
}

bool judge_weigh(const struct fit_code *code, const struct judge_limits *limits, const struct judge_view *view,
                 const struct judge_words *words, double close, double margin, struct judge_votes *votes, double *cost,
                 float *scratch)
{
    const size_t bits = code->frame.bits, size = bits * code->frame.order, likely = view->likely;
    const struct fit_code last = last_of(code, ruling_bits(&code->frame));
    const size_t part = last.frame.bits * code->frame.order;
    float *whole = scratch, *model = whole + size, *off = model + JUDGE_MOST * size;
    float *copy = off + code->span + JUDGE_MOST, *more = copy + code->span + JUDGE_MOST;
    bool leaves_more[JUDGE_MOST];

    fit_symbols(code, bits, words->rows, words->amplitude, whole);
    spread_out(code, 1, words->pedestal, whole);
    size_t count = find_off(code, view, likely, whole, off);
    double left = square_sum(off, count);
    memcpy(copy, off, count * sizeof *copy);
    *votes = votes_by(limits, view->levels, copy, count, view->noise);
    double least = cost[likely] = votes_of(off, count, votes, limits->vote);

    for (size_t c = 0; c < view->count; c++)
        if (c != likely)
            fit_chips(&last, view->levels + c, last.frame.bits, model + (c - (c > likely)) * part);
    find_models(&last, view->count - 1, model, more);
    for (size_t c = 0; c < view->count; c++)
        if (c != likely) {
            count = find_off(&last, view, c, model + (c - (c > likely)) * part, off);
            leaves_more[c] = square_sum(off, count) > left;
            cost[c] = votes_of(off, count, votes, limits->vote);
        }
    for (size_t c = 0; c < view->count; c++) {
        if (c == likely || cost[c] > least + (leaves_more[c] ? close : margin))
            continue;
        fit_chips(code, view->levels + c, bits, whole);
        find_models(code, 1, whole, more);
        count = find_off(code, view, c, whole, off);
        if (square_sum(off, count) < left)
            return false;
        cost[c] = votes_of(off, count, votes, limits->vote);
    }
    return true;
}

double judge_most(const struct judge_limits *limits, double disturbed, const struct judge_votes *votes,
                  size_t chips)
{
    double d = votes->distortion / sqrt(votes->variance), count = (double)chips;
    double density = exp(-0.5 * d * d) / sqrt(2 * 3.14159265358979323846);
    double usual = count * ((1 + d * d) * 0.5 * erfc(d / sqrt(2)) - d * density);

    return usual + 5 * sqrt(usual) + disturbed * count * limits->vote;
}
