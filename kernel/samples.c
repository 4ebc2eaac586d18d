// SPDX-License-Identifier: Apache-2.0

#include "samples.h"

#include <math.h>

#define LANES 8 /* sums that are kept apart, so that they can be added at once */

void samples_volts(const int16_t *counts, size_t size, float zero, float per_count, float *volts)
{
    for (size_t i = 0; i < size; i++)
        volts[i] = ((float)counts[i] - zero) * per_count;
}

void samples_copy(const float *volts, size_t size, double most, double *copy)
{
    for (size_t i = 0; i < size; i++)
        copy[i] = fabs((double)volts[i]) < most ? (double)volts[i] : (double)NAN;
}

struct samples_sums samples_add(const double *volts, size_t size)
{
    double sum[LANES] = {0}, squares[LANES] = {0};
    struct samples_sums all = {0, 0};
    size_t i = 0;

    for (; i + LANES <= size; i += LANES)
        for (size_t lane = 0; lane < LANES; lane++) {
            sum[lane] += volts[i + lane];
            squares[lane] += volts[i + lane] * volts[i + lane];
        }
    for (; i < size; i++) {
        all.sum += volts[i];
        all.squares += volts[i] * volts[i];
    }
    for (size_t lane = 0; lane < LANES; lane++) {
        all.sum += sum[lane];
        all.squares += squares[lane];
    }
    return all;
}

size_t samples_outside(const double *volts, size_t size, double low, double high)
{
    size_t count = 0;

    for (size_t i = 0; i < size; i++)
        count += volts[i] <= low || volts[i] >= high;
    return count;
}

bool samples_chips(const double *volts, size_t samples, double level,
                   const struct samples_edges *edges, const int32_t *places, size_t size, float *chips)
{
    double sum = 0, before = 0;
    size_t chip = 0, next = 0;

    for (size_t edge = 0; edge < edges->count && chip < size; edge++) {
        int32_t whole = edges->whole[edge];
        if (whole < 0 || (size_t)whole < next || (size_t)whole >= samples)
            return false;
        for (; next < (size_t)whole; next++)
            sum += volts[next] - level;
        double until = sum + edges->share[edge] * (volts[next] - level);
        if (edge && places[chip] == (int32_t)edge - 1)
            chips[chip++] = (float)((until - before) / edges->number[edge - 1]);
        before = until;
    }
    return chip == size;
}
