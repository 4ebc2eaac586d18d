// SPDX-License-Identifier: Apache-2.0

#include "stream.h"

#include <string.h>

static uint32_t smaller(uint64_t a, uint64_t b)
{
    return (uint32_t)(a < b ? a : b);
}

/* Words in progress */

static void forget_words(struct stream *stream)
{
    stream->held = 0;
    stream->low = INT16_MAX;
    stream->high = INT16_MIN;
}

static int16_t count_of(uint16_t word)
{
    return (int16_t)(word ^ TP_SAMPLE_XOR);
}

static bool alike(const struct stream *stream)
{
    return stream->high - stream->low <= (int32_t)stream->setup->quiet_counts;
}

/* Updates low and high with some words, unless they are already too far apart for QUIET. */
static void measure(struct stream *stream, uint32_t first, uint32_t end)
{
    int32_t low = stream->low, high = stream->high;

    if (stream->setup->quiet_counts == 0 || !alike(stream))
        return;
    for (uint32_t i = first; i < end; i++) {
        int32_t count = count_of(stream->words[i]);
        low = count < low ? count : low;
        high = count > high ? count : high;
    }
    stream->low = low;
    stream->high = high;
}

/* Instant in µs, rounded: `tick` of the stream plus thousandths of a tick. */
static uint64_t time_us(const struct stream *stream, uint64_t tick, uint64_t thousandths)
{
    uint32_t ticks_per_us = stream->setup->ticks_per_us;
    uint32_t us = ticks_per_us * STRIDE_MILLI;

    thousandths += tick % ticks_per_us * STRIDE_MILLI;
    return stream->start_us + tick / ticks_per_us + (thousandths + us / 2) / us;
}

static uint64_t first_word_us(const struct stream *stream)
{
    const struct setup *setup = stream->setup;

    if (setup->asked.integrated)
        return time_us(stream, stream->mark, setup_chip_place(setup, stream->first_chip));
    return time_us(stream, stream->index * setup->ticks_per_sample, setup->period.sample / 2);
}

static uint8_t flags(const struct stream *stream)
{
    uint8_t flags = stream->overrun ? TP_FLAG_OVERRUN : 0;

    if (stream->index == stream->mark_index) {
        flags |= TP_FLAG_SYNC;
        if (pulses_called(stream->pulses, stream->frame))
            flags |= TP_FLAG_CALLED;
    }
    return flags;
}

static void send_quiet(struct stream *stream)
{
    if (packet_open(stream->writer, TP_QUIET, sizeof stream->quiet, STREAM_RESERVE)) {
        packet_put(stream->writer, &stream->quiet, sizeof stream->quiet);
        packet_close(stream->writer);
    }
}

static void send_delayed(struct stream *stream)
{
    if (stream->delayed)
        send_quiet(stream);
    stream->delayed = false;
}

static void send_samples(struct stream *stream, uint32_t size)
{
    struct tp_samples head = {
        .device_time_us = first_word_us(stream),
        .first_index = stream->index,
        .flags = flags(stream),
    };
    size_t bytes = size * sizeof stream->words[0];

    send_delayed(stream);
    if (packet_open(stream->writer, TP_SAMPLES, sizeof head + bytes, STREAM_RESERVE)) {
        packet_put(stream->writer, &head, sizeof head);
        packet_put(stream->writer, stream->words, bytes);
        packet_close(stream->writer);
    }
}

/* Sends QUIET in place of the words; wait: delays it until the next packet. */
static void leave_out(struct stream *stream, uint32_t size, bool wait)
{
    int32_t sum = 0; /* |sum| ≤ 2¹³ words · 2¹⁵ < 2³¹ */
    uint64_t squares = 0;

    for (uint32_t i = 0; i < size; i++) {
        int32_t count = count_of(stream->words[i]);
        sum += count;
        squares += (uint32_t)(count * count);
    }
    send_delayed(stream);
    stream->quiet = (struct tp_quiet){
        .device_time_us = first_word_us(stream),
        .first_index = stream->index,
        .flags = flags(stream),
        .count = size,
        .sum = sum,
        .sum_of_squares = squares,
    };
    stream->delayed = wait;
    if (!wait)
        send_quiet(stream);
}

/* Whether the words in progress may be sent as QUIET: a whole frame, or any part of a raw gap. */
static bool may_be_quiet(const struct stream *stream)
{
    if (stream->setup->quiet_counts == 0)
        return false;
    if (stream->part == STREAM_GAP)
        return true;
    uint64_t whole = stream->setup->asked.integrated ? stream->setup->chips : stream->part_samples;
    return stream->index == stream->mark_index && stream->held == whole;
}

/* Sends the words in progress as a packet. Returns whether it was QUIET. */
static bool send_words(struct stream *stream)
{
    uint32_t size = stream->held;
    bool quiet = size && may_be_quiet(stream) && alike(stream);

    if (quiet)
        leave_out(stream, size, stream->waiting);
    else if (size)
        send_samples(stream, size);
    if (size)
        stream->overrun = false;
    stream->index += size;
    forget_words(stream);
    return quiet;
}

/* The gap is not quiet throughout: sends the words held in packets of the usual size. */
static void wait_no_more(struct stream *stream)
{
    uint32_t all = stream->held, first = 0;

    stream->waiting = false;
    stream->limit = smaller(stream->setup->gap_samples, stream->capacity);
    forget_words(stream);
    for (; all - first >= stream->limit; first += stream->limit) {
        memmove(stream->words, stream->words + first, stream->limit * sizeof stream->words[0]);
        measure(stream, 0, stream->limit);
        stream->held = stream->limit;
        send_words(stream);
    }
    memmove(stream->words, stream->words + first, (all - first) * sizeof stream->words[0]);
    measure(stream, 0, all - first);
    stream->held = all - first;
}

/* Parts of a frame period */

static void begin_part(struct stream *stream, enum stream_part part, uint64_t samples)
{
    stream->part = part;
    stream->part_samples = stream->left = samples;
}

static void begin_gap(struct stream *stream)
{
    begin_part(stream, STREAM_GAP, stream->period_left);
    stream->limit = smaller(stream->setup->gap_samples, stream->capacity);
    stream->waiting = stream->after_quiet && stream->left <= stream->capacity;
    if (stream->waiting)
        stream->limit = stream->capacity;
}

static void begin_chip(struct stream *stream)
{
    begin_part(stream, STREAM_CHIP, stride_walk(&stream->setup->chip, &stream->chip_phase));
    stream->period_left -= stream->left;
    stream->sum = 0;
    stream->chip_broken = false;
}

static void begin_guard(struct stream *stream)
{
    begin_part(stream, STREAM_GUARD, stride_walk(&stream->setup->guard, &stream->chip_phase));
    stream->period_left -= stream->left;
    stream->slot_left = stream->setup->asked.frame.resync_chips;
}

/* The next sample is the first of a frame. */
static void begin_frame(struct stream *stream)
{
    const struct setup *setup = stream->setup;

    stream->frame++;
    stream->mark += setup->period_ticks;
    stream->mark_index = stream->index;
    stream->chip_phase = stream->phase;
    stream->period_left = stride_walk(&setup->period, &stream->phase);
    stream->limit = stream->capacity;
    if (setup->asked.integrated) {
        stream->chip = 0;
        stream->slot_left = setup->asked.frame.resync_chips;
        begin_chip(stream);
    } else {
        uint64_t samples = setup->frame_samples;
        if (samples > stream->period_left)
            samples = stream->period_left;
        begin_part(stream, STREAM_FRAME, samples);
        stream->period_left -= samples;
    }
}

static void hold(struct stream *stream, uint16_t word)
{
    stream->words[stream->held] = word;
    measure(stream, stream->held, stream->held + 1);
    if (++stream->held == stream->limit)
        send_words(stream);
}

static void lose_words(struct stream *stream, uint32_t size)
{
    stream->index += size;
    stream->samples_lost += size;
    stream->overrun = true;
}

static void end_chip(struct stream *stream)
{
    if (stream->chip_broken) {
        send_words(stream);
        lose_words(stream, 1);
    } else {
        if (stream->held == 0)
            stream->first_chip = stream->chip;
        uint32_t samples = (uint32_t)stream->part_samples;
        uint32_t mean = (stream->sum * SETUP_MEAN_SCALE + samples / 2) / samples;
        hold(stream, (uint16_t)(mean ^ TP_SAMPLE_XOR));
    }
    stream->chip++;
    stream->slot_left--;
    if (stream->chip == stream->setup->chips) {
        send_words(stream);
        begin_part(stream, STREAM_GAP, stream->period_left);
    } else if (stream->slot_left == 0 && stream->setup->asked.frame.resync_chips) {
        begin_guard(stream);
    } else {
        begin_chip(stream);
    }
}

static void end_part(struct stream *stream)
{
    switch (stream->part) {
    case STREAM_GAP:
        send_words(stream);
        stream->waiting = false;
        begin_frame(stream);
        break;
    case STREAM_FRAME:
        stream->after_quiet = send_words(stream);
        begin_gap(stream);
        break;
    case STREAM_CHIP:
        end_chip(stream);
        break;
    case STREAM_GUARD:
        begin_chip(stream);
        break;
    }
}

/* Public */

void stream_init(struct stream *stream, const struct pulses *pulses, struct packet_writer *writer,
                 uint16_t *words, size_t capacity)
{
    memset(stream, 0, sizeof *stream);
    stream->pulses = pulses;
    stream->writer = writer;
    stream->words = words;
    stream->capacity = smaller(capacity, TP_MAX_SAMPLES);
}

void stream_begin(struct stream *stream, const struct setup *setup, uint64_t start_us)
{
    stream->setup = setup;
    stream->start_us = start_us;
    stream->phase = setup->period.sample / 2;
    stream->mark = setup->first_mark - setup->period_ticks; /* of a frame before the first */
    stream->frame = UINT32_MAX;
    stream->mark_index = UINT64_MAX;
    stream->index = 0;
    stream->overrun = stream->after_quiet = stream->delayed = false;
    stream->period_left = UINT64_MAX;
    if (setup->marked)
        stream->period_left = setup->first_mark / setup->ticks_per_sample;
    forget_words(stream);
    begin_gap(stream);
}

static void add_samples(struct stream *stream, const uint16_t *counts, uint32_t size)
{
    uint32_t sum = 0;

    for (uint32_t i = 0; i < size; i++)
        sum += counts[i];
    stream->sum += sum;
}

static void hold_samples(struct stream *stream, const uint16_t *counts, uint32_t size)
{
    uint16_t *words = stream->words + stream->held;

    for (uint32_t i = 0; i < size; i++)
        words[i] = counts[i] ^ TP_SAMPLE_XOR;
    measure(stream, stream->held, stream->held + size);
    stream->held += size;
    if (stream->waiting && !alike(stream))
        wait_no_more(stream);
}

void stream_samples(struct stream *stream, const uint16_t *counts, size_t size)
{
    bool integrated = stream->setup->asked.integrated;

    while (size) {
        uint32_t taken = smaller(size, stream->left);
        if (!integrated) {
            taken = smaller(taken, stream->limit - stream->held);
            hold_samples(stream, counts, taken);
        } else if (stream->part == STREAM_CHIP) {
            add_samples(stream, counts, taken);
        }
        counts += taken;
        size -= taken;
        stream->left -= taken;
        if (stream->left && !integrated && stream->held == stream->limit)
            send_words(stream);
        while (stream->left == 0)
            end_part(stream);
    }
}

void stream_lost(struct stream *stream, uint32_t size)
{
    bool integrated = stream->setup->asked.integrated;

    if (!integrated) {
        if (stream->waiting)
            wait_no_more(stream);
        send_words(stream);
    }
    while (size) {
        uint32_t lost = smaller(size, stream->left);
        size -= lost;
        stream->left -= lost;
        if (integrated)
            stream->chip_broken = true;
        else
            lose_words(stream, lost);
        while (stream->left == 0)
            end_part(stream);
    }
}

void stream_end(struct stream *stream)
{
    if (stream->waiting)
        wait_no_more(stream);
    send_words(stream);
    send_delayed(stream);
}
