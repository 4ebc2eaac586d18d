// SPDX-License-Identifier: Apache-2.0

#include "reference.h"

#include <stdlib.h>
#include <string.h>


#define LEAD_US (TP_SYNC_LEAD * TP_SYNC_UNIT_US)
#define NOT_YET (-2) /* a word whose samples have not all been taken */
#define NO_FRAME UINT64_MAX

void line_init(struct line *line, const struct settings *settings, uint64_t start_us)
{
    memset(line, 0, sizeof *line);
    line->settings = *settings;
    line->start_us = start_us;
}

void line_free(struct line *line)
{
    free(line->pulses);
    free(line->counts);
    free(line->turn);
}

/* Where a pulse of the data wire begins to hide samples, and where it ends. */
static uint64_t hidden(const struct line *line, const struct dg_pulse *pulse, bool end)
{
    wide tick = pulse->tick + (end ? LEAD_US * line->settings.ticks_per_us : 0);

    return settings_sample(&line->settings, tick * 1000);
}

/* The count that is sent for the next sample. */
static uint16_t seen(struct line *line, uint16_t count)
{
    if (line->settings.asked.sync_wire != TP_SYNC_WIRE_DATA)
        return count;
    while (line->over < line->taken && hidden(line, &line->pulses[line->over], true) <= line->size) {
        const struct dg_pulse *pulse = &line->pulses[line->over++];
        bool told = pulse->units == TP_SYNC_FRAME &&
                    line->settings.ticks_per_sample <= TP_SYNC_UNIT_US * line->settings.ticks_per_us;
        line->unseen += told && !line->follows;
        line->follows = false;
    }
    if (line->over < line->taken && hidden(line, &line->pulses[line->over], false) <= line->size) {
        line->follows |= count == LINE_LOST || abs(count - line->rest) > line->swing;
        return count == LINE_LOST ? LINE_LOST : line->rest;
    }
    if (count != LINE_LOST)
        line->rest = count;
    return count;
}

void line_add(struct line *line, const uint16_t *counts, size_t size)
{
    if (line->size + size > line->capacity) {
        line->capacity = 2 * (line->size + size);
        line->counts = realloc(line->counts, line->capacity * sizeof *line->counts);
    }
    for (size_t i = 0; i < size; i++) {
        line->counts[line->size] = seen(line, counts ? counts[i] : LINE_LOST);
        line->size++;
    }
}

/* Pulses */

static wide frame_begin(const struct line *line, uint64_t frame)
{
    return line->settings.first_mark + frame * line->settings.period;
}

/* What the next frame's pulses must say. */
static void begin_frame(struct line *line, struct wishes *wishes)
{
    if (line->frame >= line->frames) {
        line->frames = 2 * line->frames + 64;
        line->turn = realloc(line->turn, line->frames * sizeof *line->turn);
    }
    line->begun = true;
    if (wishes->number && line->frame) { /* the first one comes too soon */
        line->turn[line->frame] = 1;
        line->digits = wishes->number;
        return;
    }
    uint8_t log2_groups = line->asked_for ? line->log2_groups : wishes->log2_groups;
    if (wishes->words_log2 >= 0) {
        log2_groups = wishes->log2_groups;
        if (wishes->words_log2 > log2_groups)
            log2_groups = (uint8_t)wishes->words_log2;
        line->asked_for = (uint8_t)(1 << log2_groups);
        line->group = 0;
        wishes->words_log2 = -1;
    }
    uint8_t groups = (uint8_t)(1u << log2_groups);
    if (log2_groups != line->log2_groups)
        line->group = 0;
    line->log2_groups = log2_groups;
    line->turn[line->frame] = groups == 1 ? 0 : (uint8_t)(groups + line->group);
    line->group = (uint8_t)((line->group + 1) % groups);
    if (line->asked_for) {
        line->asked_for--;
        line->turn[line->frame] |= 32;
    }
    line->digits = line->turn[line->frame];
}

void line_pulse(struct line *line, const struct dg_pulse *pulse, struct wishes *wishes)
{
    const struct settings *settings = &line->settings;
    const struct tp_frame_layout *frame = &settings->asked.frame;
    wide announced = frame_begin(line, line->frame) + settings_chip(settings, line->chip);
    uint8_t units = TP_SYNC_RESTART;

    MUST(settings->marked, WRONG_VALUE);
    line->pulses = realloc(line->pulses, (line->taken + 1) * sizeof *line->pulses);
    line->pulses[line->taken++] = *pulse;
    wide sample = (wide)1000 * settings->ticks_per_sample;
    /* a chip's only sample is taken at 7/8 of it */
    uint64_t early = settings->asked.integrated && settings->chip == sample
                         ? settings->ticks_per_sample * 3 / 8
                         : 0;
    wide tick = (announced + 500) / 1000 - LEAD_US * settings->ticks_per_us - early;
    if (line->chip == 0 && !line->begun)
        begin_frame(line, wishes);
    if (line->chip == 0 && line->digits) {
        int digit = 31 - __builtin_clz(line->digits);
        line->digits ^= (uint16_t)(1u << digit);
        MUST(pulse->tick == tick - (wide)(digit + 1) * 128 * settings->ticks_per_us, WRONG_VALUE);
        MUST(pulse->units == TP_SYNC_RESTART, WRONG_VALUE);
        return;
    }
    if (line->chip == 0)
        units = TP_SYNC_FRAME;
    MUST(pulse->tick == tick, WRONG_VALUE);
    MUST(pulse->units == units, WRONG_VALUE);
    line->begun = false;
    line->chip += frame->resync_chips;
    if (!frame->resync_chips || line->chip >= settings->chips) {
        line->chip = 0;
        line->frame++;
    }
}

uint64_t line_covered(const struct line *line)
{
    const struct settings *settings = &line->settings;
    wide next = frame_begin(line, line->frame) + settings_chip(settings, line->chip);

    if (settings->asked.sync_wire == TP_SYNC_WIRE_DATA) /* the next pulse is taken before one is over */
        return line->taken ? hidden(line, &line->pulses[line->taken - 1], true) : 0;
    return settings->marked ? settings_sample(settings, next) : UINT64_MAX;
}

uint64_t line_ahead(const struct line *line)
{
    wide now = (wide)1000 * line->settings.ticks_per_sample * line->size;
    wide begin = line->settings.first_mark;

    return line->frame - (now < begin ? 0 : (uint64_t)((now - begin) / line->settings.period));
}

/* Words */

/* Mean of a chip's samples. */
static int32_t mean(const struct line *line, wide begin)
{
    uint64_t first = settings_sample(&line->settings, begin);
    uint64_t end = settings_sample(&line->settings, begin + line->settings.chip);
    uint64_t sum = 0;

    MUST(end > first, WRONG_VALUE);
    if (end > line->size)
        return NOT_YET;
    for (uint64_t i = first; i < end; i++) {
        if (line->counts[i] == LINE_LOST)
            return LINE_LOST;
        sum += line->counts[i];
    }
    return (int32_t)((8 * sum + (end - first) / 2) / (end - first));
}

/* When a word begins; of raw ones, when it is taken. */
static wide word_time(const struct line *line, uint64_t index)
{
    const struct settings *settings = &line->settings;
    wide sample = (wide)1000 * settings->ticks_per_sample;

    if (!settings->asked.integrated)
        return index * sample + sample / 2;
    return frame_begin(line, index / settings->chips) +
           settings_chip(settings, (uint32_t)(index % settings->chips));
}

/* A word: its count, LINE_LOST or NOT_YET. */
static int32_t word(const struct line *line, uint64_t index)
{
    if (line->settings.asked.integrated)
        return mean(line, word_time(line, index));
    return index < line->size ? line->counts[index] : NOT_YET;
}

/* Index of the first word of a frame, and of the one after its last. */
static uint64_t frame_first(const struct line *line, uint64_t frame)
{
    const struct settings *settings = &line->settings;

    return settings->asked.integrated ? frame * settings->chips : settings_mark(settings, frame);
}

static uint64_t frame_end(const struct line *line, uint64_t frame)
{
    const struct settings *settings = &line->settings;
    uint64_t next = frame_first(line, frame + 1);
    wide sample = (wide)1000 * settings->ticks_per_sample;
    wide span = settings_chip(settings, settings->chips - 1) + (1 + TP_TAIL_CHIPS) * settings->chip;

    if (settings->asked.integrated)
        return next;
    uint64_t end = frame_first(line, frame) + (uint64_t)((span + sample - 1) / sample);
    return end < next ? end : next;
}

/* The latest frame that has begun at a word. */
static uint64_t frame_at(const struct line *line, uint64_t index)
{
    const struct settings *settings = &line->settings;
    wide time = word_time(line, index);

    if (!settings->marked || time < settings->first_mark)
        return NO_FRAME;
    return (uint64_t)((time - settings->first_mark) / settings->period);
}

static void check_place(const struct line *line, const struct line_packet *packet)
{
    const struct settings *settings = &line->settings;
    uint64_t frame = frame_at(line, packet->first), end = packet->first + packet->count;
    bool within = frame != NO_FRAME && packet->first < frame_end(line, frame);
    bool sync = frame != NO_FRAME && packet->first == frame_first(line, frame);
    uint64_t gap = (uint64_t)TP_MAX_PACKET_US * settings->ticks_per_us / settings->ticks_per_sample;

    MUST(!!(packet->flags & TP_FLAG_SYNC) == sync, WRONG_VALUE);
    MUST(!!(packet->flags & 4) == (sync && line->turn[frame] & 32), WRONG_VALUE);
    MUST(packet->flags >> 3 == (sync ? line->turn[frame] & 31 : 0), WRONG_VALUE);
    if (within)
        MUST(end <= frame_end(line, frame), WRONG_VALUE);
    else if (settings->marked)
        MUST(end <= frame_first(line, frame + 1), WRONG_VALUE); /* NO_FRAME + 1 is 0 */
    if (packet->words)
        MUST(within || packet->count <= (gap ? gap : 1), WRONG_VALUE);
    else if (within)
        MUST(sync && end == frame_end(line, frame), WRONG_VALUE);
}

static void check_words(const struct line *line, const struct line_packet *packet)
{
    int32_t low = INT32_MAX, high = INT32_MIN;
    int64_t sum = 0;
    uint64_t squares = 0;

    for (uint32_t i = 0; i < packet->count; i++) {
        int32_t count = word(line, packet->first + i);
        MUST(count != NOT_YET && count != LINE_LOST, WRONG_VALUE);
        if (packet->words) {
            uint16_t sent;
            memcpy(&sent, packet->words + 2 * i, sizeof sent);
            MUST((int32_t)(sent ^ TP_SAMPLE_XOR) == count, WRONG_VALUE);
        }
        low = count < low ? count : low;
        high = count > high ? count : high;
        sum += count;
        squares += (uint64_t)count * (uint64_t)count;
    }
    if (packet->words)
        return;
    MUST(line->settings.quiet_counts > 0, WRONG_VALUE);
    MUST(high - low <= (int32_t)line->settings.quiet_counts, WRONG_VALUE);
    MUST(packet->sum == sum && packet->sum_of_squares == squares, WRONG_VALUE);
}

static bool nothing_between(const struct line *line, uint64_t end)
{
    for (uint64_t i = line->next; i < end; i++) {
        int32_t missing = word(line, i);
        if (missing == NOT_YET)
            return true;
        if (missing != LINE_LOST)
            return false;
    }
    return true;
}

void line_check(struct line *line, const struct line_packet *packet, bool dropped)
{
    uint64_t time_us = settings_us(&line->settings, word_time(line, packet->first));
    bool after_loss = packet->first && word(line, packet->first - 1) == LINE_LOST;

    MUST(packet->count > 0 && packet->first >= line->next, WRONG_VALUE);
    MUST(packet->first < line->size && packet->count <= line->size - packet->first, WRONG_VALUE);
    MUST(dropped || nothing_between(line, packet->first), UNCOUNTED_LOSS);
    MUST(!!(packet->flags & TP_FLAG_OVERRUN) == after_loss, UNCOUNTED_LOSS);
    MUST(packet->device_time_us == line->start_us + time_us, WRONG_VALUE);
    check_place(line, packet);
    check_words(line, packet);
    line->next = packet->first + packet->count;
}

void line_check_end(const struct line *line)
{
    MUST(nothing_between(line, UINT64_MAX), UNCOUNTED_LOSS);
}

uint32_t line_lost(const struct line *line)
{
    uint32_t lost = 0;

    for (uint64_t i = 0; word(line, i) != NOT_YET; i++)
        lost += word(line, i) == LINE_LOST;
    return lost;
}
