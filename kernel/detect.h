// SPDX-License-Identifier: Apache-2.0

/* Multiuser detection of sparse codes, which code/detect.py explains. Levels are
 * kept by code number, in the order of the transform, and words only of those who have some, so that what a turn costs
 * beside its two transforms grows with those who speak. In C because numpy takes milliseconds for it. */
#ifndef TACTILE_DETECT_H
#define TACTILE_DETECT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "transform.h"
#include "words.h"

/* As the constants of detect.py. swing: amplitude of a node, V; least: of a word that is taken off. negligible: V². */
struct detect_rules {
    double swing, least, soft_noise, slope, log_odds, hard_share, settled, near, negligible, stalled;
    size_t turns;
};

/* A book. rows: 2^m. walsh: their transform, unscaled. places: (k, N) of chips in their bit's 2^m. flips: (k, N).
 * codes: (2^m,) code number of every row; those of nodes are 1 … nodes. */
struct sparse_book {
    size_t bits, order, rows, nodes;
    const struct transform *walsh;
    const int32_t *places, *codes;
    const float *flips;
};

/* Codes, rising, and their words: those of a bit from (bit · rows) on, in the same order. */
struct listed {
    size_t count;
    int32_t *codes;
    float *words;
};

/* What a frame is taken apart in, and what is found there. */
struct detector {
    struct sparse_book book;
    struct detect_rules rules;
    void *memory;           /* of these: */
    float *chips;           /* (k, N), flipped back, as is `left` */
    float *left;            /* what words leave over of them */
    float *sums;            /* (k, step) levels of all codes, times the chips per bit */
    float *told;            /* (2^m) the chips of a bit's words, wherever a chip may be */
    float *spread;          /* (2^m) 0, but for a bit's chips or words while they are transformed */
    float *loud, *belief;   /* (2^m): mean |r|; share of a word that is believed */
    float *straight, *squares; /* (2^m) of those that are listed: see soften; squares of a frame's levels */
    float *amplitude;       /* (2^m) of a node, V: when it last spoke, in a frame that settled */
    float *swings;          /* (2^m) of those that are listed: as that, or what every node has */
    int32_t *unused;        /* codes of no node */
    int32_t *carried;       /* those that spoke in the last frame that settled */
    int32_t *from;          /* where a listed one was listed before, or -1 */
    int32_t *nodes;         /* (2^m) node of every code, from 0 on; -1: none */
    size_t step, unused_count, carried_count;
    struct listed now, next; /* words that are taken off; those that will be, or were found */
    double power[WORDS_MOST_BITS]; /* of what is left of a bit's chips, mean, V² */
    double level;           /* of the line, V */
};

/* As Detected: rows (k, 2^m), heard (n), left (k, N), power (k). */
struct detected {
    float *rows, *left;
    uint8_t *heard;
    double *power, level;
    bool settled;
};

struct detector *detector_new(const struct sparse_book *book, const struct detect_rules *rules); /* NULL: no memory */
void detector_free(struct detector *detector);

/* Finds words in chips (k, N), V, which are in `next` afterwards; whether they stayed the same in the end. */
bool detector_find(struct detector *detector, const float *chips, double damping);

/* The same, as Detector.detect tells it. */
void detector_detect(struct detector *detector, const float *chips, double damping, struct detected *found);

/* Mean |r| of every node, (n,) V, in chips (k, N) that are read so many later in their bits. */
void detector_loudness(struct detector *detector, const float *chips, ptrdiff_t lateness, float *loudness);

/* Levels of all codes in a bit, times the chips per bit. */
static inline float *detector_sums(const struct detector *detector, size_t bit)
{
    return detector->sums + bit * detector->step;
}

#endif
