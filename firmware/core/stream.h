// SPDX-License-Identifier: Apache-2.0

/* Turns samples into SAMPLES, PACKED and QUIET packets, as docs/protocol.md says. */
#ifndef TACTILE_STREAM_H
#define TACTILE_STREAM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "packet.h"
#include "pulses.h"
#include "setup.h"

/* Bytes of the output ring reserved for packets other than these. Chosen. */
#define STREAM_RESERVE 1024

/* Parts of a frame period. */
enum stream_part {
    STREAM_GAP,   /* between frames */
    STREAM_FRAME, /* raw: a frame and its tail */
    STREAM_CHIP,  /* integrated: one chip of a frame */
    STREAM_CHIPS, /* integrated, where samples are chips: all of them up to a guard or the frame's end */
    STREAM_GUARD, /* integrated: the pause before the nodes restart */
};

struct stream {
    const struct setup *setup;
    const struct pulses *pulses;
    struct packet_writer *writer;
    bool packs;      /* sends PACKED where counts fit */
    uint16_t *words; /* of the packet in progress, as in SAMPLES */
    uint32_t capacity;
    uint32_t samples_lost; /* since power-up */

    uint64_t start_us;     /* time of tick 0 */
    enum stream_part part; /* of the next sample */
    uint64_t left;         /* samples left of this part */
    uint64_t part_samples; /* samples of this part in all */
    uint64_t period_left;  /* samples from this part's end to the next mark */
    uint64_t mark;         /* tick of the latest frame */
    uint32_t frame;        /* its number */
    uint32_t phase;        /* of the next mark, or of a mark at the next sample (see stride.h) */

    uint64_t index;      /* of the first word in progress */
    uint32_t held;       /* words in progress */
    uint32_t limit;      /* words at which the packet is sent, unless it may become QUIET */
    int32_t low, high;   /* their extremes, until these are too far apart for QUIET */
    uint64_t mark_index; /* of the latest frame's first word */
    bool overrun;        /* words just before those in progress were lost */
    bool after_quiet;    /* the latest frame was sent as QUIET */
    bool waiting;        /* the gap may still be sent as one QUIET */
    bool delayed;        /* such a QUIET is sent with the next packet: */
    struct tp_quiet quiet;

    uint32_t chip;       /* number of the present chip in its frame */
    uint32_t first_chip; /* chip of the first word in progress */
    uint32_t slot_left;  /* chips to the next restart; without restarts more than a frame has */
    uint32_t chip_phase;
    uint32_t sum;     /* of the chip's samples */
    bool chip_broken; /* some of its samples were lost */
};

/* words: room for `capacity` words. */
void stream_init(struct stream *stream, const struct pulses *pulses, struct packet_writer *writer,
                 uint16_t *words, size_t capacity);
/* Begins a stream with these settings; its tick 0 is at start_us. */
void stream_begin(struct stream *stream, const struct setup *setup, uint64_t start_us);
/* Takes the next samples, in counts. */
void stream_samples(struct stream *stream, const uint16_t *counts, size_t size);
/* Takes note that `size` samples are missing. */
void stream_lost(struct stream *stream, uint32_t size);
/* Ends the stream: sends the words held. */
void stream_end(struct stream *stream);

#endif
