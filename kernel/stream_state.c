// SPDX-License-Identifier: Apache-2.0

#include "stream_state.h"

#include <stdlib.h>
#include <string.h>

struct stream *stream_new(struct scanner *scanner)
{
    struct stream *stream = calloc(1, sizeof *stream);

    if (!stream)
        return NULL;
    stream->scanner = scanner;
    stream->subject.rest = &stream->rest;
    stream->now = stream->arrivals;
    stream->asked = STREAM_GOES_ON;
    stream->start = stream->gap_begin = -1;
    return stream;
}

void stream_free(struct stream *stream)
{
    free(stream->store);
    free(stream);
}

bool stream_reset(struct stream *stream)
{
    bool cut_short = stream->start >= 0;

    stream->start = stream->gap_begin = -1;
    stream->kept = 0;
    stream->due = 0;
    return cut_short;
}

static bool are_possible(const struct stream_rules *rules, const struct frame_rules *frame)
{
    return rules->marked == (frame != NULL) && !(frame && frame->size > STREAM_MOST_SAMPLES) && rules->gap_size &&
           rules->gap_size <= STREAM_MOST_SAMPLES && rules->sure_gap <= rules->gap_size && rules->least_rest > 1 &&
           rules->rate_hz > 0;
}

bool stream_describe(struct stream *stream, const struct stream_rules *rules, struct frame_reader *reader,
                     uint8_t *memory)
{
    const struct frame_rules *frame = reader ? frame_reader_rules(reader) : NULL;

    stream_reset(stream);
    stream->described = false;
    if (!rules)
        return true;
    if (!are_possible(rules, frame))
        return false;
    stream->rules = *rules;
    stream->reader = reader;
    stream->frame = frame;
    if (reader)
        stream->words = words_in(memory, frame_reader_fitter(reader)->code->nodes);
    stream->rest = (struct frame_rest){0};
    stream->gap_count = stream->gap_sum = stream->gap_squares = 0;
    stream->search_waits = stream->search_pause = 0;
    memset(stream->subject.rejected, 0, sizeof stream->subject.rejected);
    return stream->described = stream_make_room(stream, reader ? frame_reader_due(reader) : 1);
}

void stream_conclude(struct stream *stream)
{
    if (stream->stage == NEXT)
        stream->stage = ENDING;
}

const struct stream_subject *stream_subject(const struct stream *stream)
{
    return &stream->subject;
}

/* Whether this was asked; it is answered now. */
static bool answers(struct stream *stream, enum stream_event question)
{
    bool asked = stream->asked == question;

    if (asked)
        stream->asked = STREAM_GOES_ON;
    return asked;
}

bool stream_place(struct stream *stream, enum stream_answer answer, uint64_t origin, bool anew, double mean,
                  double variance)
{
    bool takes = answer == STREAM_TAKE || answer == STREAM_TAKE_HELD;

    if ((takes && !stream->described) || (answer == STREAM_TAKE_HELD && !stream->holds) ||
        !answers(stream, STREAM_FOREIGN))
        return false;
    if (answer == STREAM_TAKE || answer == STREAM_HOLD) {
        stream->now->content.mean = mean;
        stream->now->content.variance = variance;
    }
    stream->stage = NEXT;
    if (answer == STREAM_IGNORE)
        return true;
    stream->holds = answer == STREAM_HOLD;
    if (answer != STREAM_TAKE)
        stream_exchange(stream);
    if (answer == STREAM_HOLD)
        return true;
    stream->waits = answer == STREAM_TAKE_HELD;
    stream->origin = origin;
    stream->end = (int64_t)(stream->now->content.first_index - origin);
    if (anew && stream_reset(stream))
        stream->subject.rejected[FRAME_INCOMPLETE]++;
    stream_pass(stream);
    return true;
}

bool stream_propose(struct stream *stream, double start, double chip)
{
    if (!answers(stream, STREAM_SEARCH))
        return false;
    frame_reader_propose(stream->reader, &(struct fit){start, chip});
    stream->is_searched = true;
    return true;
}

bool stream_gather(struct stream *stream, int64_t due)
{
    if (!answers(stream, STREAM_BLOCK))
        return false;
    stream->kept = stream->first = 0;
    if (due > stream->end && !stream_make_room(stream, (size_t)(due - stream->end)))
        return false;
    stream->due = due;
    return true;
}
