// SPDX-License-Identifier: Apache-2.0

/* Samples in, packets of samples out: cut, averaged and left out as docs/protocol.md says. */
#ifndef TACTILE_STREAM_H
#define TACTILE_STREAM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "packet.h"
#include "pulses.h"
#include "setup.h"

/* Bytes of the output that only other packets than those of samples may use. */
#define STREAM_RESERVE 1024

/* What samples belong to. */
enum stream_part {
    STREAM_GAP,   /* what is between frames */
    STREAM_FRAME, /* a frame and its tail, if raw */
    STREAM_CHIP,  /* one chip of a frame … */
    STREAM_GUARD, /* … and the pause before the nodes restart, if integrated */
};

struct stream {
    const struct setup *setup;
    const struct pulses *pulses;
    struct packet_writer *writer;
    uint16_t *words; /* of the packet in progress, as they will be sent */
    uint32_t capacity;
    uint32_t samples_lost; /* since power-up */

    uint64_t start_us;     /* time of tick 0 */
    enum stream_part part; /* of the next sample */
    uint64_t left;         /* samples until it ends */
    uint64_t part_samples; /* in it altogether */
    uint64_t period_left;  /* samples from its end to the next mark */
    uint64_t mark;         /* tick of the latest frame */
    uint32_t frame;        /* its number */
    uint32_t phase;        /* of the next mark, or of the one that is just here */

    uint64_t index;      /* of the first word in progress */
    uint32_t held;       /* words in progress */
    uint32_t limit;      /* they are sent when there are so many */
    int32_t low, high;   /* among them, until they are too far apart for QUIET */
    uint64_t mark_index; /* of the latest frame's first word */
    bool overrun;        /* words before the first one in progress were lost */
    bool after_quiet;    /* the latest frame was sent as QUIET */
    bool waiting;        /* a gap that may become one QUIET */
    bool delayed;        /* such a QUIET waits for the packet after it: */
    struct tp_quiet quiet;

    uint32_t chip;       /* number of the present one, in its frame */
    uint32_t first_chip; /* of the first word in progress */
    uint32_t slot_left;  /* chips to the next restart */
    uint32_t chip_phase;
    uint32_t sum;     /* of the chip's samples */
    bool chip_broken; /* some of them were lost */
};

/* words: room for `capacity` of them. */
void stream_init(struct stream *stream, const struct pulses *pulses, struct packet_writer *writer,
                 uint16_t *words, size_t capacity);
/* A stream in this setup; its tick 0 is at start_us. */
void stream_begin(struct stream *stream, const struct setup *setup, uint64_t start_us);
/* The next samples. */
void stream_samples(struct stream *stream, const uint16_t *counts, size_t size);
/* So many samples are missing. */
void stream_lost(struct stream *stream, uint32_t size);
/* No more come: what is held is sent. */
void stream_end(struct stream *stream);

#endif
