// SPDX-License-Identifier: Apache-2.0

/* Samples of a frame → its chips, by the likeliest of a few timings → its words and their certificate.
 *
 * Where the frame begins is known from its mark, or from the raster of others, but for less than a chip; how long its
 * chips last from the frames before. Where that leaves more than noise it is refined on the frame's own edges. If no
 * timing explains the samples, whoever asked may search for one and propose it. */
#ifndef TACTILE_FRAME_READER_H
#define TACTILE_FRAME_READER_H

#include "certificate.h"
#include "fit.h"

/* How frames are sampled. */
struct frame_rules {
    bool integrated;           /* samples are means of chips, and there are none of pauses and gaps */
    bool mean_is_offset;       /* the mean of a frame is the line's level, where no gap has shown it */
    bool searches;             /* chips may last up to most_chip: other durations may be searched for */
    size_t size;               /* samples of a frame of nominal chips */
    double tail;               /* chips after a frame that are looked at */
    double rail_low, rail_high; /* V: samples at these, or beyond, are clipped */
    double silent_power;       /* V²: of samples, below which nobody speaks, however faintly */
    double silent_chip;        /* V: of an integrated chip, below which the same holds */
    double most_noise;         /* V: of a chip, beyond which words are missed; infinite if unknown */
    double deafened, clipped;  /* share of clipped samples that makes all doubtful, and rejects a silent frame; that
                                * rejects any */
    double kept;               /* share of the chips' power that samples may have besides, but for noise */
    double misfit;             /* share of the power that words may leave, beside 3 times the noise; without words, 1 over its
                                * square is that limit of ENERGY */
    struct fit_rules fit;
};

/* The line at rest, when nobody speaks: its level, V, and the variance of a chip's level; 0 where unknown. */
struct frame_rest {
    double level, noise_v2;
    bool known;
};

enum frame_verdict {
    FRAME_SILENT,     /* nobody spoke; nothing is meant by the words */
    FRAME_READ,       /* the words are read, in doubt or not */
    FRAME_NEEDS_MORE, /* `more` samples */
    FRAME_SEARCH,     /* no timing explains the samples: another one may be proposed */
    FRAME_INCOMPLETE, /* from here on it is rejected: fewer samples than a frame has */
    FRAME_ABSURD,     /* one that no digitizer reports */
    FRAME_AT_RAIL,    /* so many that whoever spoke may not show */
    FRAME_NOISY,      /* noise would hide words */
    FRAME_MISFIT,     /* something was sent that no words explain */
    FRAME_VERDICTS
};

/* start, chip: samples, of the first chip's begin and of a chip. level: of the line at rest, V. chip_noise_v: RMS. clipped: share of samples. */
struct frame_found {
    double start, chip, level, chip_noise_v, clipped;
    size_t more;
    struct certificate certificate;
};

struct frame_reader;

/* See certifier_new. fit.reaches is kept, too. NULL also for a side that is shorter than CERTIFICATE_SIDE, or too long. */
struct frame_reader *frame_reader_new(const struct code *code, const struct frame_rules *rules,
                                      const struct certificate_limits *limits, float *expected,
                                      const uint8_t *broken);
void frame_reader_free(struct frame_reader *reader);
const struct frame_rules *frame_reader_rules(const struct frame_reader *reader);
/* What finds the timing of its frames. */
struct fitter *frame_reader_fitter(struct frame_reader *reader);

/* Tries this timing on the next frame, too; see FRAME_SEARCH. */
void frame_reader_propose(struct frame_reader *reader, const struct fit *fit);

/* The next frame begins by so many samples, at most, before or after a fit's start, with such chips; infinite: or
 * whole chips beside that. measures: start and chip are refined in any case. */
void frame_reader_expect(struct frame_reader *reader, const struct fit *fit, double scatter, bool measures);

/* A frame's mark is at this time of the digitizer, in nominal chips. Where marks keep their distance, and the frames
 * before began at theirs, the same frame some chips beside is no rival of the next one. */
void frame_reader_mark(struct frame_reader *reader, double chips);

/* Samples that a frame takes by the timing of the frames before, with its tail. */
size_t frame_reader_due(const struct frame_reader *reader);

/* Reads a frame: volts (count), NaN where absurd. final: no more will follow. searches: FRAME_SEARCH is an answer. */
enum frame_verdict frame_reader_read(struct frame_reader *reader, const float *volts, size_t count, bool final,
                                     bool searches, const struct frame_rest *rest, const struct words *words,
                                     struct frame_found *found);

/* The same of a frame in which no node transmitted, of which only mean, V, and variance, V², are known. */
enum frame_verdict frame_reader_sum_up(const struct frame_reader *reader, const struct frame_rest *rest, double mean,
                                       double variance, const struct words *words, struct frame_found *found);

#endif
