// SPDX-License-Identifier: Apache-2.0

/* What the files of the stream share: frame_stream.c goes from packet to packet, stream_state.c makes it, and is told
 * what the packets are, and what becomes of those that are asked about. */
#ifndef TACTILE_STREAM_STATE_H
#define TACTILE_STREAM_STATE_H

#include "frame_stream.h"

/* What becomes of the packet at hand next. */
enum stage {
    NEXT,    /* there is none: look for it */
    ARRIVED, /* does it continue the stream? */
    CLOSING, /* it begins a frame: decide the one in progress, learn the gap */
    SUMMED,  /* its samples are summed up */
    FILLING, /* take its samples in */
    ENDING,  /* none will come any more */
};

/* A packet of samples, and when it came. */
struct arrival {
    struct scanner_content content;
    double t_host;
    bool backlog;
};

struct stream {
    struct stream_rules rules;
    bool described;
    struct frame_reader *reader;
    const struct frame_rules *frame; /* those of the reader */
    struct words words;
    struct scanner *scanner;
    struct stream_subject subject;

    /* packets: the one at hand, and the one that is held back or, if that was taken, waits behind it */
    struct arrival arrivals[2], *now;
    enum stage stage;
    enum stream_event asked; /* what has to be answered */
    bool holds, waits;
    bool is_summed_up; /* the one at hand, by itself */
    uint32_t filled;   /* samples of it that were taken in */

    /* continuity */
    bool began;
    uint64_t origin, last_us;
    uint32_t last_count;
    int64_t end; /* of what was taken in */

    /* frames: indices are the stream's; -1: none */
    int64_t start, due, gap_begin;
    bool is_searched;                  /* the frame in progress */
    size_t search_waits, search_pause; /* frames until one may be searched for; and after the next search in vain */

    struct frame_rest rest;
    double gap_count, gap_sum, gap_squares; /* not evaluated yet */

    const uint8_t *bytes; /* not used up */
    size_t left;
    double t_host;
    bool backlog;

    struct stream_passed passed[STREAM_MOST_PASSED];
    size_t passed_count;

    float *store; /* samples: `kept` of them, the last one before `end` */
    size_t room, first, kept;
};

/* Exchanges the packet at hand with the other one. */
static inline void stream_exchange(struct stream *stream)
{
    stream->now = &stream->arrivals[stream->now == stream->arrivals];
}

/* Makes room for so many samples of a frame, with the gap before and a packet behind them; twice, so that they are
 * seldom moved. */
bool stream_make_room(struct stream *stream, size_t samples);

/* Accepts the packet at hand. */
void stream_pass(struct stream *stream);

/* Forgets the frame in progress; whether there was one. */
bool stream_reset(struct stream *stream);

#endif
