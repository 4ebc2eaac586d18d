// SPDX-License-Identifier: Apache-2.0

/* A stream of packets → its frames: takes packets out of bytes, follows the digitizer's count of samples
 * and its clock, cuts frames at marks, learns the line at rest from the gaps, and decides frames that
 * leave nothing to decide (marked_frame.h).
 *
 * It stops with an event: a frame, a packet for others, or a question, and goes on where it is once that
 * is answered. So all that is rare is decided in Python, and none of it here; what is not rare needs no
 * Python.
 *
 * In C because it is all that a packet passes through: in Python that took 400 calls for a frame of 16
 * nodes, one millisecond after a pause, and held the interpreter's lock. Nothing is allocated here per
 * packet or frame. */
#ifndef TACTILE_FRAME_STREAM_H
#define TACTILE_FRAME_STREAM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "marked_frame.h"
#include "scanner.h"

#define STREAM_MOST_PASSED 64 /* packets between two events */
#define STREAM_MOST_SAMPLES (1 << 27) /* that a frame or block may need */

/* Of a digitizer; see Pace and MarkedLine. */
struct stream_rules {
    struct frame_rules frame;
    bool marked;      /* frames are, and cut here */
    bool in_blocks;   /* they are not: samples are handed on; neither: no samples are looked at */
    double zero_count, volts_per_count; /* count → V */
    double most_volts;                  /* a sample beyond is absurd */
    size_t gap_size;                    /* most samples before a mark that are looked at */
    size_t least_rest;                  /* gap samples that an estimate takes */
    double gap_weight, rise, rise_v2;   /* as GAP_WEIGHT, Limits.rise; V² that it may rise besides */
    size_t silent_over;                 /* samples from the mark to the end of a silent frame */
    double rate_hz, slack_s, slack, gap_s, gaps, least_gap_s; /* device time and count may part; see Pace.fits */
    uint64_t most_device_us;
    double most_quiet, most_quiet_v2; /* samples; variance, V² */
};

/* How the next frames are read. */
struct stream_timing {
    size_t due, over; /* samples from the mark on until one can be decided, and is over */
    size_t uses;      /* how many may be read by it since a frame was last in doubt */
    bool has_frame;   /* frame: is meant, and its edges */
    struct frame_timing frame;
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
    STREAM_HEARD,   /* a frame in which nodes spoke; its correlations are in `rows` */
    STREAM_SILENT,  /* one in which none did */
    STREAM_PACKET,  /* a packet that is none of samples, or malformed */
    STREAM_FOREIGN, /* one of samples that does not continue the stream: stream_place answers */
    STREAM_DOUBT,   /* a frame is in doubt: stream_decide answers */
    STREAM_BLOCK,   /* samples that are handed on: stream_look answers */
    STREAM_GOES_ON, /* never returned */
};

/* What becomes of a packet that was asked about; HOLD and TAKE forget the one that is held back. */
enum stream_answer { STREAM_IGNORE, STREAM_HOLD, STREAM_TAKE, STREAM_TAKE_HELD };

/* What the last event is about. */
struct stream_subject {
    struct scanner_packet packet;
    const struct frame_rest *rest; /* of the line, now */
    int64_t start;             /* of the frame or block */
    bool final;                /* no more samples will follow */
    uint8_t turn;              /* whose, as the frame's packet says */
    bool summed_up;            /* only mean and variance of the frame are known, V and V² */
    double mean, variance;
    const float *volts;        /* NaN where absurd; until the stream goes on */
    size_t count;
    size_t marks, uses, ended; /* frames opened, timing used, ends seen at rest: since last asked */
    enum frame_look look;      /* why it is in doubt */
    struct frame_found found;  /* of a decided frame */
};

struct stream;

/* scanner: is kept. NULL: no memory. */
struct stream *stream_new(struct scanner *scanner);
void stream_free(struct stream *stream);

/* From here on packets of samples are those of such a digitizer; NULL: of an unknown one. What is known
 * of the line is forgotten. code, rows (k, N): are kept. False: no memory, or the rules are those of no frame. */
bool stream_describe(struct stream *stream, const struct stream_rules *rules,
                     const struct frame_code *code, float *rows);

/* Frames are of sparse codes, taken apart by this; false if they are others. Of those it reads, `rows`
 * begin with (k, speakers) levels of the nodes that `spoke` (n) lists. All are kept. */
bool stream_detect_by(struct stream *stream, struct sparse *sparse, int32_t *spoke);

/* Bytes to go on with, kept until they are used up; read at t_host, s. backlog: they had waited. */
void stream_give(struct stream *stream, const uint8_t *bytes, size_t size, double t_host, bool backlog);
/* How many are not used up. */
size_t stream_left(const struct stream *stream);
/* No more samples will follow: the frame in progress is decided by those there are. */
void stream_conclude(struct stream *stream);

/* Goes on up to the next event. */
enum stream_event stream_next(struct stream *stream);
/* Until the stream goes on. */
const struct stream_subject *stream_subject(const struct stream *stream);
/* The packets that passed since the last call. */
size_t stream_passed(struct stream *stream, const struct stream_passed **passed);

/* Answers; false: no memory, or nothing of the kind was asked. */

/* origin: the digitizer's index of index 0. anew: samples are missing before it. mean, variance: of a
 * Quiet, counts. cut_short: whether a frame was in progress. */
bool stream_place(struct stream *stream, enum stream_answer answer, uint64_t origin, bool anew,
                  double mean, double variance, bool *cut_short);
/* due: stream index up to which samples are needed to decide, or -1 where it is decided. over: index from
 * which on the line is at rest, or -1. level, noise: of the line at rest; see frame_rest. */
bool stream_decide(struct stream *stream, int64_t due, int64_t over, double level, double noise);
/* due: index up to which samples are gathered for the next block. */
bool stream_look(struct stream *stream, int64_t due);

/* How frames are read from here on. At any time. edges: their arrays are kept. False: no
 * memory, or the timing is that of no frame. */
bool stream_carry(struct stream *stream, const struct stream_timing *timing,
                  const struct frame_edges *edges);

#endif
