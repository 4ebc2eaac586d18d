// SPDX-License-Identifier: Apache-2.0

/* What a stream's samples were, and what therefore the packets must say that tell of them. */
#ifndef FUZZ_LINE_H
#define FUZZ_LINE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "pulses.h"
#include "settings.h"

struct line {
    struct settings settings;
    uint64_t start_us;
    uint16_t *counts; /* LINE_LOST: could not be kept */
    size_t size, capacity;
    uint64_t frame; /* that the next pulse belongs to … */
    uint32_t chip;  /* … and announces */
    uint32_t turns; /* frames of a roll call to come */
    bool *called;   /* by frame */
    size_t frames;  /* room for so many there */
    uint64_t next;  /* index of the word after the last one that was told of */
};

#define LINE_LOST UINT16_MAX

/* SAMPLES, or QUIET. */
struct line_packet {
    uint64_t device_time_us, first;
    uint8_t flags;
    uint32_t count;
    const uint8_t *words; /* as on the wire; NULL: QUIET, with these sums: */
    int64_t sum;
    uint64_t sum_of_squares;
};

void line_init(struct line *line, const struct settings *settings, uint64_t start_us);
void line_free(struct line *line);

/* Samples of the converter; counts NULL: lost ones. */
void line_add(struct line *line, const uint16_t *counts, size_t size);

/* The next pulse. call: whether a roll call was asked for since the last frame's. */
void line_pulse(struct line *line, const struct dg_pulse *pulse, bool call);
/* So many samples come before what the next pulse announces. */
uint64_t line_covered(const struct line *line);
/* Frames by which pulses are ahead of the samples. */
uint64_t line_ahead(const struct line *line);

/* The next packet. dropped: whether packets before it were dropped. */
void line_check(struct line *line, const struct line_packet *packet, bool dropped);
/* The stream was sent to its end, and nothing was dropped. */
void line_check_end(const struct line *line);
/* Words that could not be made for want of samples, so far. */
uint32_t line_lost(const struct line *line);

#endif
