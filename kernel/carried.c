// SPDX-License-Identifier: Apache-2.0

#include "carried.h"

#include <math.h>

static double share_clipped(const struct carried_line *line, const double *volts, size_t size)
{
    return (double)samples_outside(volts, size, line->rail_low, line->rail_high) / (double)size;
}

/* Without an unknown offset, V²; NaN where a sample is absurd. Finds the offset, if that is the mean. */
static double power_of(const struct carried_line *line, const double *volts, double *offset)
{
    struct samples_sums sums = samples_add(volts, line->size);
    double mean = sums.sum / (double)line->size, power = sums.squares / (double)line->size;
    double level = *offset = line->mean_is_offset ? mean : *offset;

    power = line->frame.first ? power - mean * mean : power - 2 * mean * level + level * level;
    return power < 0 ? 0 : power; /* NaN stays */
}

#define CLEARLY 0.9 /* share of a limit below which sums in any order are */

/* Whether words leave no more than the noise of the gap, as LineRecogniser._is_explained says; or those
 * of samples that are chips are believable beyond doubt, as WordFit.believable says. */
static bool is_explained(const struct carried_line *line, const struct carried_rest *rest,
                         const float *rows, float *scratch)
{
    const struct words_frame *frame = &line->frame;
    float *amplitude = scratch, *uneven = scratch + frame->nodes, pedestal, power, spread, misfit;
    double strongest = 0, active = 0;

    words_fit(frame, rows, amplitude, uneven, &pedestal, &power, &spread, &misfit);
    for (size_t node = 0; node < frame->nodes; node++) {
        strongest = (double)amplitude[node] > strongest ? (double)amplitude[node] : strongest;
        active += amplitude[node] > 0;
    }
    double left = (double)misfit * (double)power;
    double least = line->loud * line->loud * rest->noise / (double)frame->order;
    least = least < line->least_power ? line->least_power : least;
    if (!(strongest * strongest > least))
        return false;
    if (!line->integrated)
        return left < line->carried_noise * rest->noise + line->carried_misfit * (double)power;
    double words = (double)power - (double)pedestal * (double)pedestal;
    double noise = line->left * (double)frame->order / active * (double)spread * words;
    return (double)spread < CLEARLY * line->spread &&
           left < CLEARLY * (noise + line->misfit * (double)power);
}

/* Whether the line is at rest after the frame beyond doubt; see FrameEnds.observe. */
static bool is_at_rest(const struct carried_line *line, const struct carried_fit *fit,
                       const struct carried_rest *rest, const double *volts)
{
    struct samples_sums sums = samples_add(volts + fit->tail, fit->tail_samples);
    double size = (double)fit->tail_samples, mean = sums.sum / size - rest->level;
    double left = sums.squares / size - rest->level * (2 * mean + rest->level);
    double noise = rest->noise * fit->chip;

    left = left < 0 ? 0 : left;
    return left < noise * (2 + 8 / sqrt(size)) &&
           (line->frame.first || fabs(mean) <= 4 * sqrt(noise / size));
}

static bool find_chips(const struct carried_line *line, const struct carried_fit *fit, double level,
                       const double *volts, size_t count, float *chips)
{
    size_t size = line->frame.bits * line->frame.order;

    if (!line->integrated)
        return samples_chips(volts, count, level, &fit->edges, fit->places, size, chips);
    for (size_t i = 0; i < size; i++)
        chips[i] = (float)volts[i] - (float)level;
    return true;
}

enum carried carried_read(const struct carried_line *line, const struct carried_fit *fit,
                          const struct carried_rest *rest, const double *volts, size_t count,
                          float *rows, float *scratch, struct carried_found *found)
{
    const struct words_frame *frame = &line->frame;
    double power;

    found->level = rest->level;
    power = power_of(line, volts, &found->level);
    if (isnan(power))
        return CARRIED_UNDECIDED;
    if (power <= line->least_power) {
        found->noise = sqrt(power / line->chip);
        found->clipped = share_clipped(line, volts, line->size);
        double gap = sqrt(rest->noise), noise = found->noise < gap ? gap : found->noise;
        return found->clipped > line->deafened || noise > line->most_noise ? CARRIED_UNDECIDED
                                                                           : CARRIED_SILENT;
    }
    size_t heard = line->integrated ? line->heard : fit ? fit->heard : SIZE_MAX;
    if (count < heard || (fit && count < fit->tail + fit->tail_samples))
        return CARRIED_UNDECIDED;
    found->clipped = share_clipped(line, volts, heard);
    if (found->clipped > line->deafened || !find_chips(line, fit, found->level, volts, count, rows))
        return CARRIED_UNDECIDED;
    transform_multiply(line->transform, rows, rows, frame->bits);
    if (!is_explained(line, rest, rows, scratch) ||
        !(line->integrated || is_at_rest(line, fit, rest, volts)))
        return CARRIED_UNDECIDED;
    found->noise = words_noise(frame, rows, line->spare, line->spare_count);
    return CARRIED_HEARD;
}
