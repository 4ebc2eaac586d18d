// SPDX-License-Identifier: Apache-2.0

#include "marked_frame.h"

#include <math.h>

#include "vectors.h"

#define CLEARLY 0.9 /* share of a limit below which sums in any order are */

/* ---- samples → chips ----------------------------------------------------------------------------- */

VECTORS void samples_volts(const int16_t *restrict counts, size_t size, float zero, float per_count, float most,
                           float *restrict volts)
{
    for (size_t i = 0; i < size; i++) {
        float level = ((float)counts[i] - zero) * per_count;
        volts[i] = fabsf(level) < most ? level : NAN;
    }
}

/* Adds up floats, or doubles if `wide`, which is a constant where this is inlined. */
INLINE struct samples_sums add_up(const void *volts, const bool wide, size_t size)
{
    const double *doubles = volts;
    const float *floats = volts;
    doubles4 sum[2] = {{0}, {0}}, squares[2] = {{0}, {0}};
    struct samples_sums all = {0, 0};
    size_t i = 0;

    for (; i + 8 <= size; i += 8)
        for (size_t half = 0; half < 2; half++) {
            size_t at = i + 4 * half;
            doubles4 four = wide ? *(const doubles4 *)(doubles + at)
                                 : __builtin_convertvector(*(const floats4 *)(floats + at), doubles4);
            sum[half] += four;
            squares[half] += four * four;
        }
    for (; i < size; i++) {
        double level = wide ? doubles[i] : (double)floats[i];
        all.sum += level;
        all.squares += level * level;
    }
    for (size_t lane = 0; lane < 8; lane++) {
        all.sum += sum[lane / 4][lane % 4];
        all.squares += squares[lane / 4][lane % 4];
    }
    return all;
}

VECTORS struct samples_sums samples_add(const float *volts, size_t size)
{
    return add_up(volts, false, size);
}

VECTORS struct samples_sums samples_add_wide(const double *volts, size_t size)
{
    return add_up(volts, true, size);
}

VECTORS size_t samples_outside(const float *volts, size_t size, double low, double high)
{
    size_t count = 0;

    for (size_t i = 0; i < size; i++)
        count += (size_t)((double)volts[i] <= low) | (size_t)((double)volts[i] >= high);
    return count;
}

bool samples_chips(const float *volts, size_t samples, double level,
                   const struct samples_edges *edges, const int32_t *places, size_t size, float *chips)
{
    double sum = 0, before = 0;
    size_t chip = 0, next = 0;

    for (size_t edge = 0; edge < edges->count && chip < size; edge++) {
        int32_t whole = edges->whole[edge];
        if (whole < 0 || (size_t)whole < next || (size_t)whole >= samples)
            return false;
        for (; next < (size_t)whole; next++)
            sum += (double)volts[next] - level;
        double until = sum + edges->share[edge] * ((double)volts[next] - level);
        if (edge && places[chip] == (int32_t)edge - 1)
            chips[chip++] = (float)((until - before) / edges->number[edge - 1]);
        before = until;
    }
    return chip == size;
}

/* ---- frames ------------------------------------------------------------------------------------- */

static double share_clipped(const struct frame_rules *rules, const float *volts, size_t size)
{
    return (double)samples_outside(volts, size, rules->rail_low, rules->rail_high) / (double)size;
}

/* Without an unknown offset, V²; NaN where a sample is absurd. Finds the offset, if that is the mean. */
static double power_of(const struct frame_rules *rules, const struct frame_rest *rest,
                       const float *volts, double *level)
{
    struct samples_sums sums = samples_add(volts, rules->size);
    double mean = sums.sum / (double)rules->size, power = sums.squares / (double)rules->size;

    *level = rules->mean_is_offset && !rest->known ? mean : rest->level;
    power = rules->frame.first ? power - mean * mean
                               : power - 2 * mean * *level + *level * *level;
    return power < 0 ? 0 : power; /* NaN stays */
}

/* As MarkedLine.silent. power: of the samples, V². */
static enum frame_look silent(const struct frame_rules *rules, const struct frame_rest *rest,
                              double power, struct frame_found *found)
{
    double gap = sqrt(rest->noise), noise = sqrt(power / rules->chip);
    double most = rules->silent_rise * (rest->noise * rules->chip) + rules->silent_more;

    found->noise = noise;
    if (found->clipped > rules->deafened)
        return FRAME_CLIPPED;
    if ((noise < gap ? gap : noise) > rules->most_noise || (rules->scrambled && power > most))
        return FRAME_NOISY;
    return FRAME_SILENT;
}

enum frame_look frame_summed_up(const struct frame_rules *rules, const struct frame_rest *rest,
                                double mean, double variance, struct frame_found *found)
{
    *found = (struct frame_found){.level = rest->level,
                                  .clipped = mean <= rules->rail_low || mean >= rules->rail_high,
                                  .rest = rest->noise};
    return silent(rules, rest, variance, found);
}

/* Whether words leave no more than the noise of the gap, and chips have the power of their samples, as
 * LineRecogniser._is_explained and _is_kept say; or those of samples that are chips are believable beyond
 * doubt, as WordFit.believable says; and the frame does not look as if a bit began or ended at rest. outermost:
 * the least level of the bits' first and last chips, V; ends: of the frame's. sampled: power of the samples, V². */
static bool is_explained(const struct frame_rules *rules, const struct frame_rest *rest,
                         const float *rows, double outermost, double ends, double sampled, float *scratch)
{
    const struct words_frame *frame = &rules->frame;
    float *amplitude = scratch, *uneven = scratch + frame->nodes, pedestal, power, spread, misfit;
    double strongest = 0, weakest = INFINITY, active = 0;

    words_fit(frame, rows, amplitude, uneven, &pedestal, &power, &spread, &misfit);
    for (size_t node = 0; node < frame->nodes; node++) {
        strongest = (double)amplitude[node] > strongest ? (double)amplitude[node] : strongest;
        if (amplitude[node] > 0) {
            weakest = (double)amplitude[node] < weakest ? (double)amplitude[node] : weakest;
            active += 1;
        }
    }
    double left = (double)misfit * (double)power;
    double least = rules->loud * rules->loud * rest->noise / (double)frame->order;
    least = least < rules->least_power ? rules->least_power : least;
    if (!(strongest * strongest > least))
        return false;
    bool is_odd = (size_t)active % 2 || CLEARLY * weakest < rules->whole * (double)frame->swing;
    bool may_be_shifted = active <= rules->few && !rules->scrambled;
    bool may_rest = !rules->scrambled && CLEARLY * CLEARLY * ends * ends < rules->at_rest * rules->at_rest * left;
    if ((may_be_shifted || may_rest) && left > CLEARLY * rules->hiding * weakest * weakest)
        return false;
    if (may_be_shifted && is_odd && !frame->unipolar &&
        CLEARLY * outermost < rules->rest * weakest)
        return false;
    if (!rules->integrated &&
        CLEARLY * ((double)power + left) < rules->kept * (sampled - rest->noise * rules->chip))
        return false;
    if (!rules->integrated)
        return left < rules->carried_noise * rest->noise + rules->carried_misfit * (double)power;
    double words = (double)power - (double)pedestal * (double)pedestal;
    double noise = (double)frame->order / active * (double)spread * words;
    double a_chip = CLEARLY * rules->chips / (double)frame->order;
    if (may_be_shifted) /* as WordFit.is_clear */
        return (double)spread < CLEARLY * rules->clear_spread &&
               left < CLEARLY * (rules->carried_noise * noise + rules->carried_misfit * (double)power) &&
               words_most_left(frame, rows, amplitude) < 2 * a_chip * weakest * weakest;
    if (!rules->scrambled && (left >= a_chip * words || words_most_left(frame, rows, amplitude) >= a_chip / 2 * words))
        return false;
    return (double)spread < CLEARLY * rules->spread &&
           left < CLEARLY * (rules->left * noise + rules->misfit * (double)power);
}

/* Whether the line is at rest after the frame beyond doubt, as FrameEnds.observe says. */
static bool is_at_rest(const struct frame_rules *rules, const struct frame_timing *timing,
                       const struct frame_rest *rest, const float *volts, size_t count, bool *ended)
{
    size_t end = timing->tail_end < count ? timing->tail_end : count;
    double size = end > timing->tail ? (double)(end - timing->tail) : 0;

    *ended = size >= rules->least_tail * timing->chip;
    if (!*ended)
        return true;
    struct samples_sums sums = samples_add(volts + timing->tail, end - timing->tail);
    double mean = sums.sum / size - rest->level;
    double left = sums.squares / size - rest->level * (2 * mean + rest->level);
    double noise = rest->noise * timing->chip;

    left = left < 0 ? 0 : left;
    return left < noise * (rules->tail_noise + rules->tail_scatter / sqrt(size)) &&
           (rules->frame.first || fabs(mean) <= rules->tail_level * sqrt(noise / size));
}

/* The chips of a frame, without flips. False where they are not within its samples. */
VECTORS static bool find_chips(const struct frame_rules *rules, const struct frame_code *code,
                               const struct frame_edges *edges, double level, const float *restrict volts,
                               size_t count, float *restrict chips)
{
    size_t size = rules->frame.bits * rules->frame.order;

    if (!rules->integrated && !samples_chips(volts, count, level, &edges->all, edges->places, size, chips))
        return false;
    for (size_t i = 0; rules->integrated && i < size; i++)
        chips[i] = volts[i] - (float)level;
    for (size_t i = 0; code->flips && i < size; i++)
        chips[i] *= code->flips[i];
    return true;
}

/* Whether a bit's first or last chips are more than noise may be, as MarkedLine._sticks_out says. */
static bool chip_stands_out(const struct frame_rules *rules, const float *volts, double level)
{
    const size_t order = rules->frame.order, edges[] = {0, 1, order - 2, order - 1};
    double most = 0;

    for (size_t bit = 0; order >= 2 && bit < rules->frame.bits; bit++, volts += order)
        for (size_t i = 0; i < sizeof edges / sizeof *edges; i++)
            most = fmax(most, fabs((double)volts[edges[i]] - level));
    return most > CLEARLY * rules->rest * (double)rules->frame.swing;
}

/* A frame of sparse codes, of chips that are samples. */
static enum frame_look read_sparse(const struct frame_code *code, const float *volts, float *rows,
                                   struct frame_found *found)
{
    struct sparse_told told;

    if (!sparse_read(code->sparse, volts, &found->rest, rows, code->spoke, &told))
        return FRAME_UNEXPLAINED;
    found->level = told.level;
    found->noise = told.noise;
    found->speakers = told.speakers;
    return FRAME_HEARD;
}

enum frame_look frame_read(const struct frame_rules *rules, const struct frame_code *code,
                           const struct frame_timing *timing, const struct frame_edges *edges,
                           const struct frame_rest *rest, const float *volts, size_t count,
                           bool final, float *rows, float *scratch, struct frame_found *found)
{
    const struct words_frame *frame = &rules->frame;

    const size_t order = code->sparse ? sparse_book(code->sparse)->order : frame->order;
    const size_t chips = frame->bits * order;

    *found = (struct frame_found){.level = rest->level, .rest = rest->noise};
    if (count < rules->size)
        return FRAME_CUT_SHORT;
    double power = power_of(rules, rest, volts, &found->level);
    if (isnan(power))
        return FRAME_ABSURD;
    const double noise = fmin(rules->noise_share * rest->noise, rules->most_silent_noise);
    if (power <= rules->silent_power + noise) {
        if (rules->integrated && !code->sparse && chip_stands_out(rules, volts, found->level))
            return FRAME_UNEXPLAINED;
        if (code->sparse)
            found->rest = sparse_learn(code->sparse, found->rest, power);
        found->clipped = share_clipped(rules, volts, rules->size);
        return silent(rules, rest, power, found);
    }
    if (!rules->integrated && !rest->known)
        return FRAME_UNKNOWN_REST;
    if (!(rules->integrated || timing))
        return FRAME_NO_TIMING;
    /* All edges of chips lie within more samples than the frame has. */
    size_t heard = rules->integrated ? rules->whole_size : timing->heard;
    if (rules->integrated ? count < chips : count <= heard)
        return FRAME_CUT_SHORT;
    if (rules->integrated && count > chips)
        return FRAME_UNEXPLAINED;
    if (heard > count) /* pauses between bits have no samples, if these are chips */
        heard = count;
    found->clipped = share_clipped(rules, volts, heard);
    if (found->clipped > rules->deafened)
        return FRAME_CLIPPED;
    if (code->sparse)
        return read_sparse(code, volts, rows, found);
    if (!find_chips(rules, code, edges, found->level, volts, count, rows))
        return FRAME_NO_TIMING;
    double outermost = INFINITY, ends = fmin(fabs((double)rows[0]), fabs((double)rows[chips - 1]));
    for (size_t bit = 0; bit < frame->bits; bit++) {
        double first = fabs((double)rows[bit * frame->order]);
        double last = fabs((double)rows[(bit + 1) * frame->order - 1]);
        outermost = outermost < first ? outermost : first;
        outermost = outermost < last ? outermost : last;
    }
    transform_multiply(code->transform, rows, rows, frame->bits);
    if (!is_explained(rules, rest, rows, outermost, ends, power, scratch))
        return FRAME_UNEXPLAINED;
    if (!rules->integrated) {
        double missing = timing->until - (double)count;
        if (missing > 0.5 && !final) {
            found->more = (size_t)ceil(missing);
            return FRAME_NEEDS_MORE;
        }
        if (!is_at_rest(rules, timing, rest, volts, count, &found->ended))
            return FRAME_NOT_AT_REST;
    }
    found->noise = words_noise(frame, rows, rules->spare, rules->spare_count);
    return FRAME_HEARD;
}
