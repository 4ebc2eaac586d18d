// SPDX-License-Identifier: Apache-2.0

/* A frame of a start and a chip duration in samples: its chips, where its edges are, and which of a few timings it has.
 *
 * Times are in samples; sample i is the line's level at instant i. */
#ifndef TACTILE_FIT_H
#define TACTILE_FIT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "certificate.h"

/* Counts of a converter as volts: (count − zero)·per_count, in float; those not within ±most, V, become NaN. */
void samples_volts(const int16_t *counts, size_t size, float zero, float per_count, float most, float *volts);

/* What samples add up to: their sum and the sum of their squares. */
struct samples_sums {
    double sum, squares;
};

struct samples_sums samples_add(const float *volts, size_t size);

/* Samples of a line, V, its level of rest, and sums of the samples without that: sums[i] is that of the first
 * i. At most 2³¹ − 1 samples. */
struct fit_line {
    size_t size;
    const float *volts;
    const double *sums;
    double level;
};

struct fit {
    double start, chip;
};

/* Instant at which the last of so many chips ends. */
static inline double fit_end(const struct fit *fit, size_t span)
{
    return fit->start + fit->chip * (double)span;
}

/* Running sums of `size` values without a level: size + 1, from 0 on. */
void fit_sums(const float *values, size_t size, double level, double *sums);

/* Mean level, V, of `count` chips on end, of which number `lead` is the first of the fit. */
void fit_levels(const struct fit_line *line, const struct fit *fit, double blur, size_t lead, size_t count,
                float *levels);

#define FIT_EDGE 0.5 /* of a sample by which a chip beside may reach beyond the samples */

/* What timings frames may have, and how they are looked for. */
struct fit_rules {
    double chip, least_chip, most_chip; /* samples: nominal, and limits */
    double earliest, latest;   /* samples from the first one: between these the frame begins */
    size_t side;               /* chips before a frame and after it that are looked at where they are seen */
    double refined;            /* share of the power that a carried timing may leave, beside 1.5 times the noise */
    double searched; /* share of the power, beside 3 times the noise, from which other timings are searched for */
    double tied;               /* share by which words some chips beside must explain more to be taken */
    double blur;               /* samples around an edge of which it is uncertain on which side they were taken */
    double settled_chips;      /* change below which refinement ends */
    size_t turns;              /* of refinement, and … */
    const double *reaches;     /* … in each of them, part of a chip on either side of an edge that is looked at */
};

/* A place at which a frame may begin as well, and by how many chips that is later. */
struct fit_place {
    struct fit fit;
    int shift;
};

struct fitter {
    const struct code *code;
    struct fit_rules *rules;
    struct certifier *certifier;
    struct fit carried, proposed; /* of the frame before, and one that was proposed; chip 0: none */
    struct fit taken;             /* by which the chips are */
    bool is_free, measures;       /* it may begin whole chips beside that, too; that is refined in any case */
    struct fit_place places[CERTIFICATE_BESIDE]; /* where else, and of how many of these the words explain as much */
    size_t place_count;
    struct fit_line line;         /* samples of a frame, */
    double *sums;                 /* their sums, */
    size_t room;                  /* and for how many of these there is room */
    float *levels;                /* (span + 2·side) V, chips by a fit, with those beside and pauses */
    float *halves;                /* (2·span) V, of chips */
    float *chips, *split;         /* (k, N) of these; see certificate_view */
    float *scratch;               /* (2·k·N + span + 2) V, of a fit that is refined */
};

/* Rules are kept, and may be changed. False: no memory; it is to be freed in any case. */
bool fitter_make(struct fitter *fitter, const struct code *code, struct fit_rules *rules, struct certifier *certifier);
void fitter_free(struct fitter *fitter);

/* Takes these samples for the line, whose level at rest that is, until the next call; false: no memory. */
bool fitter_line(struct fitter *fitter, const float *volts, size_t count, double level);

/* Chips by a fit, into `levels` with those beside the frame, and into `chips`. */
void fitter_take(struct fitter *fitter, const struct fit *fit);

/* What changes within the chips of a fit. */
const float *fitter_split(struct fitter *fitter, const struct fit *fit);

/* Whether a timing leaves so much that another one is searched for. */
bool fitter_is_poor(const struct fitter *fitter, double left, double power, double noise);

/* The timing of the frames before where that explains this one, else the best of it, of one that was proposed, and of
 * these refined. left, power: mean squares, V². False where none is possible. */
bool fitter_find(struct fitter *fitter, double noise, struct fit *best, double *left, double *power);

/* Moves a frame that may begin anywhere by whole chips to where its words explain most, and keeps the other places at
 * which they explain nearly as much. */
void fitter_choose(struct fitter *fitter, struct fit *best);

/* Power, V², that words explain of the chips of `count` fits, of which each begins a chip later. */
void fitter_explained(struct fitter *fitter, struct fit fit, size_t count, double *powers);

/* Duration of chips, samples, by which a frame that begins there ends where the line is no longer as loud as that, V, up
 * to two chips later, or one earlier: the first of these whose words explain the frame, else that which explains most;
 * 0: nothing does. noise: V², of a chip. */
double fitter_duration(struct fitter *fitter, double noise, double start, double loud);

/* Energy, V² times samples, that words of constant amplitude explain of the first bits of a frame that begins there, by
 * each of `count` durations of chips. All nodes count, even if faint: what noise has there is the same for all. */
void fitter_gains(struct fitter *fitter, double start, size_t bits, const double *chips, size_t count, double *gains);

#endif
