// SPDX-License-Identifier: Apache-2.0

#include "steady.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

struct steady {
    struct steady_setting setting;
    struct steady_place place;
    struct steady_timing timing;
    struct scanner *scanner;
    float *rows, *scratch;
    float packet[TP_MAX_SAMPLES]; /* V */
    int16_t counts[TP_MAX_SAMPLES];
    uint64_t origin;
    size_t uses, marks;
    struct carried_found found;
    int64_t decided; /* start of the frame that was decided last */

    const uint8_t *bytes; /* not used up */
    size_t left;
    double t_host;
    bool backlog;

    struct steady_passed passed[STEADY_MOST_PASSED];
    size_t passed_count;

    double *store; /* samples: `kept` of them, the last one before place.end */
    size_t room, first, kept;
};

struct steady *steady_new(const struct steady_setting *setting, struct scanner *scanner, float *rows)
{
    struct steady *steady = calloc(1, sizeof *steady);

    if (!steady)
        return NULL;
    steady->scratch = malloc(2 * (setting->line.frame.nodes + 1) * sizeof(float));
    if (!steady->scratch) {
        free(steady);
        return NULL;
    }
    steady->setting = *setting;
    steady->scanner = scanner;
    steady->rows = rows;
    return steady;
}

void steady_free(struct steady *steady)
{
    free(steady->store);
    free(steady->scratch);
    free(steady);
}

/* ---- samples ----------------------------------------------------------------------------------- */

static size_t larger(size_t some, size_t other)
{
    return some > other ? some : other;
}

bool steady_enter(struct steady *steady, const struct steady_place *place, uint64_t origin,
                  const struct steady_timing *timing, const double *volts, size_t count)
{
    const struct steady_setting *setting = &steady->setting;
    /* Of a frame in progress, of the gap before it, and a packet; twice, so that they seldom move. */
    size_t room = 2 * (larger(timing->due, setting->line.size) + setting->gap_size + TP_MAX_SAMPLES);

    if (room > steady->room) {
        double *store = malloc(room * sizeof *store);
        if (!store)
            return false;
        free(steady->store);
        steady->store = store;
        steady->room = room;
    }
    if (count > setting->gap_size) {
        volts += count - setting->gap_size;
        count = setting->gap_size;
    }
    if (count)
        memcpy(steady->store, volts, count * sizeof *volts);
    steady->first = 0;
    steady->kept = count;
    steady->place = *place;
    steady->origin = origin;
    steady->timing = *timing;
    steady->uses = steady->marks = steady->passed_count = 0;
    steady->left = 0;
    return true;
}

size_t steady_samples(const struct steady *steady, int64_t *begin, const double **volts)
{
    int64_t first = steady->place.end - (int64_t)steady->kept;

    if (*begin < first)
        *begin = first;
    if (*begin > steady->place.end)
        *begin = steady->place.end;
    *volts = steady->store + steady->first + (*begin - first);
    return (size_t)(steady->place.end - *begin);
}

static void forget_before(struct steady *steady, int64_t index)
{
    int64_t count = index - (steady->place.end - (int64_t)steady->kept);

    if (count > (int64_t)steady->kept)
        count = (int64_t)steady->kept;
    if (count > 0) {
        steady->first += (size_t)count;
        steady->kept -= (size_t)count;
    }
}

static void append(struct steady *steady, const float *volts, size_t count)
{
    if (steady->first + steady->kept + count > steady->room) {
        memmove(steady->store, steady->store + steady->first, steady->kept * sizeof *steady->store);
        steady->first = 0;
    }
    samples_copy(volts, count, steady->setting.most_volts,
                 steady->store + steady->first + steady->kept);
    steady->kept += count;
    steady->place.end += (int64_t)count;
}

/* ---- the line at rest -------------------------------------------------------------------------- */

/* As MarkedLine.at_rest, of a line whose level is known. */
static void at_rest(struct steady *steady, double mean, double variance)
{
    const struct steady_setting *setting = &steady->setting;
    struct steady_place *place = &steady->place;
    double newest = variance / setting->line.chip;
    double most = setting->rise * place->noise + setting->rise_v2;

    newest = newest < most ? newest : most;
    place->noise += setting->gap_weight * (newest - place->noise);
    place->level = mean;
}

/* As MarkedLine.add_gap, of the gap before a mark at this index. */
static void learn_gap(struct steady *steady, int64_t index)
{
    struct steady_place *place = &steady->place;
    int64_t earliest = index - (int64_t)steady->setting.gap_size;
    int64_t begin = place->gap_begin > earliest ? place->gap_begin : earliest;
    const double *volts;
    size_t count = steady_samples(steady, &begin, &volts);

    if (!count)
        return;
    struct samples_sums sums = samples_add(volts, count);
    if (isnan(sums.sum))
        return;
    place->gap_count += (double)count;
    place->gap_sum += sums.sum;
    place->gap_squares += sums.squares;
    if (place->gap_count >= (double)steady->setting.least_rest) {
        double number = place->gap_count, mean = place->gap_sum / number;
        double left = place->gap_squares - number * (mean * mean);
        at_rest(steady, mean, (left < 0 ? 0 : left) / (number - 1));
        place->gap_count = place->gap_sum = place->gap_squares = 0;
    }
}

/* A mark at the end of what was taken in. */
static void mark(struct steady *steady)
{
    struct steady_place *place = &steady->place;

    if (place->gap_begin >= 0)
        learn_gap(steady, place->end);
    forget_before(steady, place->end);
    place->start = place->mark = place->end;
    steady->marks++;
}

/* ---- packets ----------------------------------------------------------------------------------- */

/* Whether a packet continues the stream, as Pace.is_plausible and follows say; nothing is missing. */
static bool continues(const struct steady *steady, uint64_t first_index, uint64_t device_us)
{
    const struct steady_setting *setting = &steady->setting;
    const struct steady_place *place = &steady->place;

    if (first_index != steady->origin + (uint64_t)place->end || device_us > setting->most_device_us)
        return false;
    double counted_s = (double)place->last_count / setting->rate_hz;
    double ahead_s = (double)((int64_t)device_us - (int64_t)place->last_us) * 1e-6 - counted_s;
    return -setting->behind_s <= ahead_s && ahead_s <= setting->ahead_s + setting->ahead * counted_s;
}

static void pass(struct steady *steady, const struct scanner_packet *packet, uint64_t device_us,
                 uint32_t count)
{
    steady->passed[steady->passed_count++] = (struct steady_passed){
        .index = steady->place.end,
        .device_time_us = device_us,
        .count = count,
        .sequence = packet->sequence,
        .backlog = steady->backlog,
        .t_host = steady->t_host,
    };
    steady->place.last_us = device_us;
    steady->place.last_count = count;
}

static enum steady_event heard(struct steady *steady, enum carried carried)
{
    struct steady_place *place = &steady->place;

    steady->decided = place->start;
    place->start = place->gap_begin = -1;
    place->level = steady->found.level;
    if (steady->setting.line.integrated) { /* what follows is words, and no noise */
        steady->uses += carried == CARRIED_HEARD;
        return carried == CARRIED_HEARD ? STEADY_HEARD : STEADY_SILENT;
    }
    if (carried == CARRIED_SILENT) {
        place->gap_begin = steady->decided + (int64_t)steady->setting.silent_over;
        return STEADY_SILENT;
    }
    place->gap_begin = steady->decided + (int64_t)steady->timing.over;
    steady->uses++;
    return STEADY_HEARD;
}

static enum steady_event decide(struct steady *steady)
{
    const struct steady_timing *timing = &steady->timing;
    const struct steady_place *place = &steady->place;
    struct carried_rest rest = {place->level, place->noise};
    const struct carried_fit *fit = steady->uses < timing->most_uses ? timing->fit : NULL;
    int64_t begin = place->start;
    const double *volts;

    steady_samples(steady, &begin, &volts);
    enum carried carried = carried_read(&steady->setting.line, fit, &rest, volts, timing->due,
                                        steady->rows, steady->scratch, &steady->found);
    return carried == CARRIED_UNDECIDED ? STEADY_UNDECIDED : heard(steady, carried);
}

static enum steady_event take_samples(struct steady *steady, const struct scanner_packet *packet)
{
    size_t count = scanner_samples(packet);
    struct steady_place *place = &steady->place;
    struct tp_samples head;

    if (!count)
        return STEADY_PACKET;
    scanner_copy_samples(packet, &head, steady->counts);
    bool sync = head.flags == TP_FLAG_SYNC;
    if ((head.flags && !sync) || (sync && place->start >= 0) ||
        !continues(steady, head.first_index, head.device_time_us))
        return STEADY_PACKET;
    pass(steady, packet, head.device_time_us, (uint32_t)count);
    if (sync)
        mark(steady);
    samples_volts(steady->counts, count, steady->setting.zero, steady->setting.per_count,
                  steady->packet);
    append(steady, steady->packet, count);
    if (place->start < 0)
        forget_before(steady, place->end - (int64_t)steady->setting.gap_size);
    else if (place->end - place->start >= (int64_t)steady->timing.due)
        return decide(steady);
    return STEADY_MORE;
}

/* Sums of a frame in which no node transmitted, or of a part of the gap; as MarkedTiming.quiet. */
static enum steady_event take_quiet(struct steady *steady, const struct scanner_packet *packet)
{
    const struct steady_setting *setting = &steady->setting;
    struct steady_place *place = &steady->place;
    struct tp_quiet quiet;

    if (packet->size != sizeof quiet)
        return STEADY_PACKET;
    memcpy(&quiet, packet->payload, sizeof quiet);
    /* Up to 2²¹ samples all sums are exact in 64 bits. */
    bool sync = quiet.flags == TP_FLAG_SYNC;
    if ((quiet.flags && !sync) || place->start >= 0 || !quiet.count || quiet.count >= 1 << 21 ||
        (sync && quiet.count < setting->line.size) || (double)quiet.count > setting->most_quiet ||
        quiet.sum < -((int64_t)quiet.count << 15) || quiet.sum > (int64_t)quiet.count << 15 ||
        quiet.sum_of_squares > (uint64_t)quiet.count << 30 ||
        !continues(steady, quiet.first_index, quiet.device_time_us))
        return STEADY_PACKET;
    double count = (double)quiet.count, mean_counts = (double)quiet.sum / count;
    double spread = (double)quiet.count * (double)quiet.sum_of_squares -
                    (double)quiet.sum * (double)quiet.sum;
    double variance = spread / (count * count) * (setting->volts_per_count * setting->volts_per_count);
    double mean = (mean_counts - setting->zero_count) * setting->volts_per_count;
    double noise = sqrt(variance / setting->line.chip);
    /* The gap before a mark is learnt first, which raises its noise to this at most. */
    double rise = (setting->rise - 1) * place->noise + setting->rise_v2;
    double gap = sqrt(place->noise + setting->gap_weight * rise);
    if (!(variance >= 0 && variance <= setting->most_quiet_v2) ||
        mean <= setting->line.rail_low || mean >= setting->line.rail_high ||
        (sync && (noise < gap ? gap : noise) > setting->line.most_noise))
        return STEADY_PACKET;
    pass(steady, packet, quiet.device_time_us, quiet.count);
    if (sync)
        mark(steady);
    else if (place->gap_begin >= 0)
        at_rest(steady, mean, variance);
    place->end += quiet.count;
    steady->first = steady->kept = 0;
    if (!sync) {
        place->gap_begin = place->gap_begin < 0 ? -1 : place->end;
        return STEADY_MORE;
    }
    steady->found = (struct carried_found){place->level, noise, 0};
    enum steady_event event = heard(steady, CARRIED_SILENT);
    place->gap_begin = setting->line.integrated ? -1 : place->end;
    return event;
}

void steady_give(struct steady *steady, const uint8_t *bytes, size_t size, double t_host, bool backlog)
{
    steady->bytes = bytes;
    steady->left = size;
    steady->t_host = t_host;
    steady->backlog = backlog;
}

size_t steady_left(const struct steady *steady, const uint8_t **bytes)
{
    *bytes = steady->bytes;
    return steady->left;
}

enum steady_event steady_next(struct steady *steady, struct scanner_packet *packet)
{
    enum steady_event event = STEADY_MORE;

    while (event == STEADY_MORE && steady->left) {
        size_t taken = scanner_take(steady->scanner, steady->bytes, steady->left, packet);
        steady->bytes += taken;
        steady->left -= taken;
        if (!packet->payload)
            continue;
        if (packet->type == TP_SAMPLES || packet->type == TP_PACKED)
            event = take_samples(steady, packet);
        else
            event = packet->type == TP_QUIET ? take_quiet(steady, packet) : STEADY_PACKET;
        if (event == STEADY_MORE && steady->passed_count == STEADY_MOST_PASSED)
            event = STEADY_FULL;
    }
    return event;
}

const struct carried_found *steady_found(const struct steady *steady)
{
    return &steady->found;
}

int64_t steady_start(const struct steady *steady)
{
    return steady->decided;
}

const struct steady_place *steady_place(const struct steady *steady)
{
    return &steady->place;
}

size_t steady_uses(const struct steady *steady)
{
    return steady->uses;
}

size_t steady_marks(const struct steady *steady)
{
    return steady->marks;
}

size_t steady_passed(struct steady *steady, const struct steady_passed **passed)
{
    size_t count = steady->passed_count;

    *passed = steady->passed;
    steady->passed_count = 0;
    return count;
}
