// SPDX-License-Identifier: Apache-2.0

#include "stream_state.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* ---- samples ----------------------------------------------------------------------------------- */

bool stream_make_room(struct stream *stream, size_t samples)
{
    size_t room = 2 * (samples + stream->rules.gap_size + TP_MAX_SAMPLES);

    if (room <= stream->room)
        return true;
    float *store = samples <= STREAM_MOST_SAMPLES ? malloc(room * sizeof *store) : NULL;
    if (!store)
        return false;
    if (stream->kept)
        memcpy(store, stream->store + stream->first, stream->kept * sizeof *store);
    free(stream->store);
    stream->store = store;
    stream->room = room;
    stream->first = 0;
    return true;
}

/* Samples from index `begin` on, as far as they are kept, up to `end`. */
static const float *samples_from(const struct stream *stream, int64_t begin, int64_t end, size_t *count)
{
    int64_t first = stream->end - (int64_t)stream->kept;

    begin = begin < first ? first : begin;
    end = end > stream->end ? stream->end : end;
    *count = end > begin ? (size_t)(end - begin) : 0;
    return stream->store + stream->first + (*count ? begin - first : 0);
}

static void forget_before(struct stream *stream, int64_t index)
{
    int64_t count = index - (stream->end - (int64_t)stream->kept);

    if (count > (int64_t)stream->kept)
        count = (int64_t)stream->kept;
    if (count > 0) {
        stream->kept -= (size_t)count;
        stream->first = stream->kept ? stream->first + (size_t)count : 0; /* memory that is cached */
    }
}

/* Takes in the next samples of the packet at hand; those of a quiet one are made up from its mean and variance. */
static void fill(struct stream *stream)
{
    const struct scanner_content *now = &stream->now->content;
    double zero = stream->rules.zero_count, per_count = stream->rules.volts_per_count;
    float most = (float)stream->rules.most_volts;
    size_t count = now->count - stream->filled;

    count = count < TP_MAX_SAMPLES ? count : TP_MAX_SAMPLES; /* of both kinds alike */
    if (stream->first + stream->kept + count > stream->room) {
        memmove(stream->store, stream->store + stream->first, stream->kept * sizeof *stream->store);
        stream->first = 0;
    }
    float *volts = stream->store + stream->first + stream->kept;
    if (now->quiet) {
        float mean = (float)((now->mean - zero) * per_count);
        float deviation = (float)sqrt(now->variance * (per_count * per_count));
        const float levels[2] = {mean + deviation, mean - deviation};
        for (size_t i = 0; i < count; i++)
            volts[i] = fabsf(levels[i % 2]) < most ? levels[i % 2] : NAN;
    } else
        samples_volts(now->counts, count, (float)zero, (float)per_count, most, volts);
    stream->kept += count;
    stream->end += (int64_t)count;
    stream->filled += (uint32_t)count;
}

/* ---- the line at rest -------------------------------------------------------------------------- */

/* Takes in mean and variance of samples in which nobody spoke. */
static void at_rest(struct stream *stream, double mean, double variance)
{
    const struct stream_rules *rules = &stream->rules;
    struct frame_rest *rest = &stream->rest;
    double newest = variance / stream->frame->fit.chip, weight = rest->known ? rules->gap_weight : 1;
    double most = rules->rise * rest->noise_v2 + rules->rise_v2;

    if (rest->known && most < newest)
        newest = most;
    rest->noise_v2 += weight * (newest - rest->noise_v2);
    rest->level = mean;
    rest->known = true;
}

/* Takes in the gap before a mark at the end of what was taken in. */
static void learn_gap(struct stream *stream)
{
    int64_t earliest = stream->end - (int64_t)stream->rules.gap_size;
    int64_t begin = stream->gap_begin > earliest ? stream->gap_begin : earliest;
    size_t count;
    const float *volts = samples_from(stream, begin, stream->end, &count);

    if (!count)
        return;
    struct samples_sums sums = samples_add(volts, count);
    if (isnan(sums.sum))
        return;
    stream->gap_count += (double)count;
    stream->gap_sum += sums.sum;
    stream->gap_squares += sums.squares;
    if (stream->gap_count >= (double)stream->rules.least_rest) {
        double number = stream->gap_count, mean = stream->gap_sum / number;
        double left = stream->gap_squares - number * (mean * mean);
        at_rest(stream, mean, (left < 0 ? 0 : left) / (number - 1));
        stream->gap_count = stream->gap_sum = stream->gap_squares = 0;
    }
}

/* ---- packets ----------------------------------------------------------------------------------- */

static enum stream_event find_packet(struct stream *stream)
{
    if (stream->passed_count == STREAM_MOST_PASSED)
        return STREAM_FULL;
    if (stream->waits) {
        stream->waits = false;
        stream_exchange(stream);
        stream->stage = ARRIVED;
        return STREAM_GOES_ON;
    }
    if (!stream->left)
        return STREAM_NEEDS_BYTES;
    size_t taken = scanner_take(stream->scanner, stream->bytes, stream->left, &stream->subject.packet);
    stream->bytes += taken;
    stream->left -= taken;
    if (!stream->subject.packet.payload)
        return STREAM_GOES_ON;
    if (!scanner_read(&stream->subject.packet, &stream->now->content))
        return STREAM_PACKET;
    stream->now->t_host = stream->t_host;
    stream->now->backlog = stream->backlog;
    stream->stage = ARRIVED;
    return STREAM_GOES_ON;
}

/* Whether the packet at hand continues the stream, as Pace.is_plausible and follows say, with nothing missing. */
static bool continues(const struct stream *stream)
{
    const struct stream_rules *rules = &stream->rules;
    const struct scanner_content *now = &stream->now->content;

    if (!stream->described || !stream->began || stream->holds ||
        now->first_index != stream->origin + (uint64_t)stream->end ||
        now->device_us > rules->most_device_us)
        return false;
    if (now->quiet &&
        !(now->is_exact && (double)now->count <= rules->most_quiet &&
          now->variance * (rules->volts_per_count * rules->volts_per_count) <= rules->most_quiet_v2))
        return false;
    double counted_s = (double)stream->last_count / rules->rate_hz;
    double ahead_s = (double)((int64_t)now->device_us - (int64_t)stream->last_us) * 1e-6 - counted_s;
    double slack_s = rules->slack_s + rules->slack * counted_s;
    double gap_s = now->sync ? rules->gap_s + rules->gaps * counted_s : 0;
    double least_s = now->sync ? rules->least_gap_s : 0;
    return least_s - slack_s <= ahead_s && ahead_s <= slack_s + gap_s;
}

void stream_pass(struct stream *stream)
{
    const struct stream_rules *rules = &stream->rules;
    const struct scanner_content *now = &stream->now->content;

    stream->passed[stream->passed_count++] = (struct stream_passed){
        .index = stream->end,
        .device_time_us = now->device_us,
        .count = now->count,
        .sequence = now->sequence,
        .backlog = stream->now->backlog,
        .t_host = stream->now->t_host,
    };
    stream->began = true;
    stream->last_us = now->device_us;
    stream->last_count = now->count;
    stream->filled = 0;
    if (!rules->marked) {
        stream->stage = rules->in_blocks ? FILLING : NEXT;
        stream->end += rules->in_blocks ? 0 : now->count;
        return;
    }
    stream->is_summed_up = now->quiet && (now->sync ? now->count >= stream->frame->size : stream->start < 0);
    stream->stage = now->sync ? CLOSING : stream->is_summed_up ? SUMMED : FILLING;
}

static enum stream_event arrive(struct stream *stream)
{
    if (!continues(stream))
        return STREAM_FOREIGN;
    stream_pass(stream);
    return STREAM_GOES_ON;
}

/* ---- frames ------------------------------------------------------------------------------------ */

/* The frame in progress is over; the line is at rest from `over` samples after its mark on. */
static void settle(struct stream *stream, double over)
{
    const struct frame_found *found = &stream->subject.found;
    bool is_integrated = stream->frame->integrated; /* then no gap is sent */

    stream->subject.start = stream->start;
    stream->gap_begin = is_integrated ? -1 : stream->start + (int64_t)ceil(over);
    stream->start = -1;
    if (is_integrated) {
        stream->rest.level = found->level;
        stream->rest.noise_v2 = found->chip_noise_v * found->chip_noise_v;
    }
}

/* What becomes of the frame in progress. */
static enum stream_event decided(struct stream *stream, enum frame_verdict verdict)
{
    const struct frame_rules *rules = stream->frame;
    struct stream_subject *subject = &stream->subject;
    struct frame_found *found = &subject->found;

    if (verdict == FRAME_NEEDS_MORE && stream_make_room(stream, subject->count + found->more)) {
        stream->due += (int64_t)found->more;
        return STREAM_GOES_ON;
    }
    if (verdict == FRAME_SEARCH) {
        subject->start = stream->start;
        return STREAM_SEARCH;
    }
    if (verdict > FRAME_READ) { /* it may last as long as any */
        subject->rejected[verdict]++;
        settle(stream, (double)rules->size * rules->fit.most_chip / rules->fit.chip + rules->fit.chip);
        return STREAM_GOES_ON;
    }
    subject->has_words = verdict == FRAME_READ;
    settle(stream, found->start + found->chip * ((double)frame_reader_fitter(stream->reader)->code->span + 0.5));
    return STREAM_FRAME;
}

/* The frame in progress, by its samples up to an index. */
static enum stream_event decide(struct stream *stream, int64_t end, bool final)
{
    struct stream_subject *subject = &stream->subject;
    bool searches = !stream->is_searched && !stream->search_waits;

    subject->volts = samples_from(stream, stream->start, end, &subject->count);
    enum frame_verdict verdict = frame_reader_read(stream->reader, subject->volts, subject->count, final, searches,
                                             &stream->rest, &stream->words, &subject->found);
    /* A timing that explains the frame: words may be in doubt for other reasons, as that they have rivals. */
    bool is_found = verdict == FRAME_READ && subject->found.certificate.value[CLAUSE_ENERGY] < 1;
    if (stream->is_searched && verdict != FRAME_NEEDS_MORE) {
        stream->search_pause = is_found ? 0 : 2 * stream->search_pause + 1;
        stream->search_pause = stream->search_pause < stream->rules.most_waits ? stream->search_pause
                                                                               : stream->rules.most_waits;
        stream->search_waits = stream->search_pause;
    }
    return decided(stream, verdict);
}

static enum stream_event begin_frame(struct stream *stream)
{
    if (stream->start >= 0)
        return decide(stream, stream->end, true);
    const struct scanner_content *now = &stream->now->content;
    double device_s = 1e-6 * (double)now->device_us;
    if (stream->gap_begin < 0 && !stream->frame->integrated) /* since a hole, where there was a gap in any case */
        stream->gap_begin = stream->end - (int64_t)stream->rules.sure_gap;
    if (stream->gap_begin >= 0)
        learn_gap(stream);
    forget_before(stream, stream->end);
    stream->start = stream->end;
    frame_reader_mark(stream->reader, device_s * stream->rules.rate_hz / stream->frame->fit.chip);
    stream->subject.turn = now->turn;
    stream->subject.asked = now->asked;
    stream->is_searched = false;
    stream->search_waits -= stream->search_waits > 0;
    stream->due = stream->start + (int64_t)frame_reader_due(stream->reader);
    if (!stream_make_room(stream, frame_reader_due(stream->reader)))
        stream->due = stream->start + 1; /* it is incomplete then */
    stream->stage = stream->is_summed_up ? SUMMED : FILLING;
    return STREAM_GOES_ON;
}

/* After a packet that is summed up. */
static void pass_by(struct stream *stream)
{
    stream->end += stream->now->content.count;
    stream->kept = 0;
    stream->gap_begin = stream->gap_begin < 0 ? -1 : stream->end;
    stream->stage = NEXT;
}

/* Sums of a frame in which no node transmitted, or of a part of the gap. */
static enum stream_event sum_up(struct stream *stream)
{
    double per_count = stream->rules.volts_per_count;
    double mean = (stream->now->content.mean - stream->rules.zero_count) * per_count;
    double variance = stream->now->content.variance * (per_count * per_count);

    if (stream->start < 0) {
        if (stream->gap_begin >= 0)
            at_rest(stream, mean, variance);
        pass_by(stream);
        return STREAM_GOES_ON;
    }
    enum frame_verdict verdict = frame_reader_sum_up(stream->reader, &stream->rest, mean, variance,
                                                     &stream->words, &stream->subject.found);
    enum stream_event event = decided(stream, verdict);
    pass_by(stream);
    return event;
}

static enum stream_event hand_on(struct stream *stream)
{
    struct stream_subject *subject = &stream->subject;

    subject->start = stream->end - (int64_t)stream->kept;
    subject->volts = samples_from(stream, subject->start, stream->end, &subject->count);
    return STREAM_BLOCK;
}

static enum stream_event take_in(struct stream *stream)
{
    bool is_due = stream->end >= stream->due;

    if (stream->rules.in_blocks && stream->kept && (is_due || stream->kept + TP_MAX_SAMPLES > stream->room))
        return hand_on(stream);
    if (stream->start >= 0 && is_due) /* more values than chips tell that one was taken twice */
        return decide(stream, stream->frame->integrated ? stream->end : stream->due, false);
    if (stream->filled < stream->now->content.count)
        fill(stream);
    else
        stream->stage = NEXT;
    if (stream->start < 0 && stream->rules.marked)
        forget_before(stream, stream->end - (int64_t)stream->rules.gap_size);
    return STREAM_GOES_ON;
}

static enum stream_event conclude(struct stream *stream)
{
    if (stream->start >= 0)
        return decide(stream, stream->end, true);
    if (stream->rules.in_blocks && stream->kept)
        return hand_on(stream);
    stream_reset(stream);
    stream->stage = NEXT;
    return STREAM_GOES_ON;
}

enum stream_event stream_next(struct stream *stream)
{
    static enum stream_event (*const steps[])(struct stream *) = {
        [NEXT] = find_packet, [ARRIVED] = arrive, [CLOSING] = begin_frame,
        [SUMMED] = sum_up, [FILLING] = take_in, [ENDING] = conclude};
    enum stream_event event = stream->asked; /* as long as it is not answered */

    while (event == STREAM_GOES_ON)
        event = steps[stream->stage](stream);
    stream->asked = event >= STREAM_FOREIGN ? event : STREAM_GOES_ON;
    return event;
}

/* ---- bytes in, packets out ------------------------------------------------------------------------ */

bool stream_give(struct stream *stream, const uint8_t *bytes, size_t size, double t_host, bool backlog)
{
    if (stream->left)
        return false;
    stream->bytes = bytes;
    stream->left = size;
    stream->t_host = t_host;
    stream->backlog = backlog;
    return true;
}

size_t stream_passed(struct stream *stream, const struct stream_passed **passed)
{
    size_t count = stream->passed_count;

    *passed = stream->passed;
    stream->passed_count = 0;
    return count;
}
