// SPDX-License-Identifier: Apache-2.0

#include "stream.h"

#include <string.h>

#include "turn.h"

#define PACKED_PAIRS 64 /* packed at once. Chosen: their bytes lie on the stack */

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

    if (stream->index == stream->mark_index)
        flags |= (uint8_t)(TP_FLAG_SYNC | turn_flags(pulses_turn(stream->pulses, stream->frame)));
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

static void send_words_as_they_are(struct stream *stream, const uint16_t *words, uint32_t size)
{
    struct tp_samples head = {
        .device_time_us = first_word_us(stream),
        .first_index = stream->index,
        .flags = flags(stream),
    };
    size_t bytes = size * sizeof words[0];

    if (packet_open(stream->writer, TP_SAMPLES, sizeof head + bytes, STREAM_RESERVE)) {
        packet_put(stream->writer, &head, sizeof head);
        packet_put(stream->writer, words, bytes);
        packet_close(stream->writer);
    }
}

/* Adds the counts of words, in steps of 2^shift, to the open packet: two of them in three bytes. */
static void put_packed(struct packet_writer *writer, const uint16_t *words, uint32_t size,
                       uint8_t shift)
{
    /* the lowest bits of the XOR, which are those of a value's, where a count is shifted */
    const uint16_t mask = (uint16_t)(TP_SAMPLE_XOR << shift) ^ TP_SAMPLE_XOR;
    uint8_t bytes[3 * PACKED_PAIRS];

    while (size) {
        uint32_t taken = size < 2 * PACKED_PAIRS ? size : 2 * PACKED_PAIRS;
        uint8_t *next = bytes;

        for (const uint16_t *word = words, *end = words + (taken & ~1u); word != end; word += 2) {
            uint32_t a = (uint16_t)(word[0] ^ mask) >> shift, b = (uint16_t)(word[1] ^ mask) >> shift;
            uint32_t pair = (a & 0xFFFu) | b << 12;
            *next++ = (uint8_t)pair;
            *next++ = (uint8_t)(pair >> 8);
            *next++ = (uint8_t)(pair >> 16);
        }
        if (taken & 1u) {
            uint32_t last = (uint16_t)(words[taken - 1] ^ mask) >> shift & 0xFFFu;
            *next++ = (uint8_t)last;
            *next++ = (uint8_t)(last >> 8);
        }
        packet_put(writer, bytes, (size_t)(next - bytes));
        words += taken;
        size -= taken;
    }
}

static void send_packed(struct stream *stream, const uint16_t *words, uint32_t size, uint8_t shift)
{
    struct tp_packed head = {
        .device_time_us = first_word_us(stream),
        .first_index = stream->index,
        .flags = flags(stream),
        .step = (uint8_t)(1u << shift),
    };

    if (packet_open(stream->writer, TP_PACKED, sizeof head + (3 * size + 1) / 2, STREAM_RESERVE)) {
        packet_put(stream->writer, &head, sizeof head);
        put_packed(stream->writer, words, size, shift);
        packet_close(stream->writer);
    }
}

static void send_samples(struct stream *stream, const uint16_t *words, uint32_t size)
{
    const struct setup *setup = stream->setup;

    send_delayed(stream);
    if (stream->packs && setup->samples_are_chips)
        send_packed(stream, words, size, SETUP_MEAN_SHIFT);
    else if (stream->packs && !setup->asked.integrated)
        send_packed(stream, words, size, 0);
    else
        send_words_as_they_are(stream, words, size);
}

/* Sends QUIET in place of the words; wait: delays it until the next packet. */
static void leave_out(struct stream *stream, uint32_t size, bool wait)
{
    int64_t sum = 0;
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

static void pass_words(struct stream *stream, uint32_t size)
{
    stream->index += size;
    stream->first_chip += size;
    stream->overrun = false;
}

/* Sends the words in progress as packets. Returns whether it was one QUIET. */
static bool send_words(struct stream *stream)
{
    uint32_t size = stream->held;
    bool quiet = size && may_be_quiet(stream) && alike(stream);

    if (quiet) {
        leave_out(stream, size, stream->waiting);
        pass_words(stream, size);
    }
    for (uint32_t first = 0, part; !quiet && first < size; first += part) {
        part = smaller(size - first, TP_MAX_SAMPLES);
        send_samples(stream, stream->words + first, part);
        pass_words(stream, part);
    }
    forget_words(stream);
    return quiet;
}

/* Words at which those in progress are sent. A frame that may still be QUIET is held as long as there is
 * room. */
static uint32_t limit(const struct stream *stream)
{
    bool in_frame = stream->part != STREAM_GAP && stream->index == stream->mark_index;

    return in_frame && stream->setup->quiet_counts && alike(stream) ? stream->capacity
                                                                   : stream->limit;
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

/* Where samples are chips: the chip of the next sample. */
static uint32_t present_chip(const struct stream *stream)
{
    return stream->chip + (uint32_t)(stream->part_samples - stream->left);
}

static void begin_part(struct stream *stream, enum stream_part part, uint64_t samples)
{
    stream->part = part;
    stream->part_samples = stream->left = samples;
}

/* The frame after this gap may be earlier or later. */
static void move_mark(struct stream *stream)
{
    int64_t moved = pulses_moved(stream->pulses, stream->frame + 1);

    stream->period_left += (uint64_t)moved;
    stream->mark += (uint64_t)(moved * stream->setup->ticks_per_sample);
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
    if (stream->setup->samples_are_chips) {
        uint32_t left = smaller(stream->slot_left, stream->setup->chips - stream->chip);
        begin_part(stream, STREAM_CHIPS, left);
        stream->period_left -= left;
        return;
    }
    begin_part(stream, STREAM_CHIP, stride_walk(&stream->setup->chip, &stream->chip_phase));
    stream->period_left -= stream->left;
    stream->sum = 0;
    stream->chip_broken = false;
}

/* The next sample is the first of a chip that follows a restart. */
static void begin_slot(struct stream *stream)
{
    uint16_t resync_chips = stream->setup->asked.frame.resync_chips;

    stream->slot_left = resync_chips ? resync_chips : UINT32_MAX;
    begin_chip(stream);
}

static void begin_guard(struct stream *stream)
{
    begin_part(stream, STREAM_GUARD, stride_walk(&stream->setup->guard, &stream->chip_phase));
    stream->period_left -= stream->left;
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
    stream->limit = smaller(stream->capacity, TP_MAX_SAMPLES);
    if (setup->asked.integrated) {
        stream->chip = 0;
        begin_slot(stream);
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
    if (++stream->held >= limit(stream))
        send_words(stream);
}

static void lose_words(struct stream *stream, uint32_t size)
{
    stream->index += size;
    stream->samples_lost += size;
    stream->overrun = true;
}

/* Goes on after a chip. */
static void go_on(struct stream *stream)
{
    if (stream->chip == stream->setup->chips) {
        send_words(stream);
        move_mark(stream);
        begin_part(stream, STREAM_GAP, stream->period_left);
    } else if (stream->slot_left == 0) {
        begin_guard(stream);
    } else {
        begin_chip(stream);
    }
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
        uint32_t mean = ((stream->sum << SETUP_MEAN_SHIFT) + samples / 2) / samples;
        hold(stream, (uint16_t)(mean ^ TP_SAMPLE_XOR));
    }
    stream->chip++;
    stream->slot_left--;
    go_on(stream);
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
        move_mark(stream);
        begin_gap(stream);
        break;
    case STREAM_CHIP:
        end_chip(stream);
        break;
    case STREAM_CHIPS:
        stream->chip += (uint32_t)stream->part_samples;
        stream->slot_left -= (uint32_t)stream->part_samples;
        go_on(stream);
        break;
    case STREAM_GUARD:
        begin_slot(stream);
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
    stream->capacity = (uint32_t)capacity;
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

    if (stream->held == 0)
        stream->first_chip = present_chip(stream);
    if (stream->setup->asked.integrated)
        for (uint32_t i = 0; i < size; i++)
            words[i] = (uint16_t)(counts[i] << SETUP_MEAN_SHIFT) ^ TP_SAMPLE_XOR;
    else
        for (uint32_t i = 0; i < size; i++)
            words[i] = counts[i] ^ TP_SAMPLE_XOR;
    measure(stream, stream->held, stream->held + size);
    stream->held += size;
    if (stream->waiting && !alike(stream))
        wait_no_more(stream);
}

/* Whether the samples of the present part are words. */
static bool has_words(const struct stream *stream)
{
    return stream->part == STREAM_CHIPS || !stream->setup->asked.integrated;
}

void stream_samples(struct stream *stream, const uint16_t *counts, size_t size)
{
    while (size) {
        uint32_t taken = smaller(size, stream->left);
        if (has_words(stream)) {
            taken = smaller(taken, limit(stream) - stream->held);
            hold_samples(stream, counts, taken);
        } else if (stream->part == STREAM_CHIP) {
            add_samples(stream, counts, taken);
        }
        counts += taken;
        size -= taken;
        stream->left -= taken;
        while (stream->left == 0)
            end_part(stream);
        if (stream->held >= limit(stream))
            send_words(stream);
    }
}

void stream_lost(struct stream *stream, uint32_t size)
{
    while (size) {
        uint32_t lost = smaller(size, stream->left);
        if (has_words(stream)) {
            if (stream->waiting)
                wait_no_more(stream);
            send_words(stream);
            lose_words(stream, lost);
        }
        size -= lost;
        stream->left -= lost;
        stream->chip_broken = true;
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
