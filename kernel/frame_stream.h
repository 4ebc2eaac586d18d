// SPDX-License-Identifier: Apache-2.0

/* A stream of packets → its frames: takes packets out of bytes, follows the digitizer's count of samples
 * and its clock, cuts frames at marks, learns the line at rest from the gaps, and reads frames (frame_reader.h).
 *
 * It stops with an event: a frame, a packet for others, or a question, and goes on where it is once that
 * is answered. Python answers what is rare: where packets belong after a loss, and which timing may explain
 * samples that the known ones do not. Nothing is allocated per packet or frame. */
#ifndef TACTILE_FRAME_STREAM_H
#define TACTILE_FRAME_STREAM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "frame_reader.h"
#include "scanner.h"

#define STREAM_MOST_PASSED 64 /* packets between two events */
#define STREAM_MOST_SAMPLES (1 << 27) /* that a frame or block may need */

/* Of a digitizer; see Pace. */
struct stream_rules {
    bool marked;    /* frames are, and cut here */
    bool in_blocks; /* they are not: samples are handed on; neither: no samples are looked at */
    double zero_count, volts_per_count; /* count → V */
    double most_volts;                  /* a sample beyond is absurd */
    size_t gap_size;                    /* most samples before a mark that are looked at */
    size_t sure_gap;                    /* samples before any mark in which nobody speaks */
    size_t least_rest;                  /* gap samples that an estimate takes */
    double gap_weight, rise, rise_v2;   /* weight of the newest estimate; times that it may rise; V² besides */
    size_t most_waits;                  /* frames, after a search without success, before the next one */
    double rate_hz, slack_s, slack, gap_s, gaps, least_gap_s; /* device time and count may part; see Pace.fits */
    uint64_t most_device_us;
    double most_quiet, most_quiet_v2; /* samples; variance, V² */
};

/* A packet that was accepted. */
struct stream_passed {
    int64_t index; /* of its first sample, in the stream */
    uint64_t device_time_us;
    uint32_t count;
    uint16_t sequence;
    bool backlog;
    double t_host;
};

enum stream_event {
    STREAM_NEEDS_BYTES,
    STREAM_FULL,    /* STREAM_MOST_PASSED packets passed; nothing else */
    STREAM_FRAME,   /* a frame; its words, if it has any, are in the memory that was lent */
    STREAM_PACKET,  /* a packet that is none of samples, or malformed */
    STREAM_FOREIGN, /* one of samples that does not continue the stream: stream_place answers */
    STREAM_SEARCH,  /* no timing explains a frame: stream_propose answers */
    STREAM_BLOCK,   /* samples that are handed on: stream_gather answers */
    STREAM_GOES_ON, /* never returned */
};

/* What becomes of a packet that was asked about; HOLD and TAKE forget the one that is held back. */
enum stream_answer { STREAM_IGNORE, STREAM_HOLD, STREAM_TAKE, STREAM_TAKE_HELD };

/* What the last event is about. */
struct stream_subject {
    struct scanner_packet packet;
    const struct frame_rest *rest; /* of the line, now */
    int64_t start;                 /* of the frame or block */
    uint8_t turn;                  /* whose, as the frame's packet says, … */
    bool asked;                    /* … and whether all of these were asked to speak */
    bool has_words;                /* of a frame: somebody may have spoken */
    const float *volts;            /* NaN where absurd; until the stream goes on */
    size_t count;
    struct frame_found found;
    uint64_t rejected[FRAME_VERDICTS]; /* frames, by why, since the stream was described */
};

struct stream;

/* scanner: is kept. NULL: no memory. */
struct stream *stream_new(struct scanner *scanner);
void stream_free(struct stream *stream);

/* From here on packets of samples are those of such a digitizer; rules NULL: of an unknown one. What is known of
 * the line is forgotten. reader: of marked frames, NULL for others; memory: where their words go, see words_in; both
 * are kept. False: no memory, or the rules are those of no frame. */
bool stream_describe(struct stream *stream, const struct stream_rules *rules, struct frame_reader *reader,
                     uint8_t *memory);

/* Bytes to go on with, kept until they are used up; read at t_host, s. backlog: they had waited. False while others are
 * not used up. */
bool stream_give(struct stream *stream, const uint8_t *bytes, size_t size, double t_host, bool backlog);
/* No more samples will follow: the frame in progress is decided by those there are. */
void stream_conclude(struct stream *stream);

/* Goes on up to the next event. */
enum stream_event stream_next(struct stream *stream);
/* Until the stream goes on. */
const struct stream_subject *stream_subject(const struct stream *stream);
/* The packets that passed since the last call. */
size_t stream_passed(struct stream *stream, const struct stream_passed **passed);

/* Answers; false: no memory, or nothing of the kind was asked. */

/* origin: the digitizer's index of index 0. anew: samples are missing before it. mean, variance: of a Quiet, counts. */
bool stream_place(struct stream *stream, enum stream_answer answer, uint64_t origin, bool anew, double mean,
                  double variance);
/* A timing to try on the frame that is asked about, samples from its first one on; chip 0: none. */
bool stream_propose(struct stream *stream, double start, double chip);
/* due: index up to which samples are gathered for the next block. */
bool stream_gather(struct stream *stream, int64_t due);

#endif
