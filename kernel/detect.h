// SPDX-License-Identifier: Apache-2.0

/* Multiuser detection: which nodes of a sparse book spoke in a frame, and what.
 *
 * Codes are not orthogonal, so that every row holds a part of what every other one has, as noise. It is taken off in
 * turns (approximate message passing: Donoho, Maleki, Montanari 2009): the levels of all rows give the likeliest words,
 * these the chips, and what is left of the frame's chips better levels. A node's k bits decide together whether it
 * spoke, which they do with more noise than any bit could be read in. While much is left, words are soft, and what is
 * left is corrected for having been made of these levels (Onsager's term); then they are hard, with the amplitude that
 * they show. The line's offset is one unknown more.
 *
 * Levels are kept by code number, in the order of the transform, and words only of those who have some, so
 * that what a turn costs beside its two transforms grows with those who speak. */
#ifndef TACTILE_DETECT_H
#define TACTILE_DETECT_H

#include "code.h"

/* What a code that is sparse has besides: its book, and rules, of which framing/sparse.py says what each is. Amplitudes
 * are shares of a node's. */
struct sparse_code {
    size_t rows;                   /* 2^m */
    const struct transform *walsh; /* of all rows, unscaled */
    const int32_t *places;         /* (k, N) of the chips in their bit's 2^m */
    const int32_t *numbers;        /* (2^m) code number of every row; those of nodes are 1 … n */
    double least, slope, span, hard, near, settled, damping; /* of the search for words: detect.c */
    size_t turns;                  /* of that, and pairs of bits that are turned in a bit, at most */
    size_t capacity;               /* most nodes that are told apart in a frame */
    double hidden, faintest;       /* of the certificate: sparse.c */
    bool may_cancel;               /* codes are so short that those of a few nodes may add up to nothing */
};

/* Codes, rising, and their words: those of a bit from (bit · rows) on, in the same order. */
struct listed {
    size_t count;
    int32_t *codes;
    float *words;
};

/* What a frame is taken apart in, and what is found there. */
struct detector {
    struct code code;
    const struct sparse_code *book;
    float *floats;          /* of all that follow */
    float *chips;           /* (k, N), flipped back, as is `left` */
    float *left;            /* what words leave over of them */
    float *sums;            /* (k, step) levels of all codes, times the chips per bit */
    float *told;            /* (2^m) the chips of a bit's words, wherever a chip may be */
    float *spread;          /* (2^m) 0, but for a bit's chips or words while they are transformed */
    float *loud, *belief;   /* (2^m): mean |r|; share of a word that is believed */
    float *straight, *squares; /* (2^m) of those that are listed: see soften; free once words are found */
    int32_t *nodes;         /* (2^m) node of every code, from 0 on; -1: none */
    int32_t *from;          /* where a listed one was listed before, or -1 */
    size_t step;
    struct listed now, next; /* words that are taken off; those that will be, or were found */
    double offset;          /* of the line, V */
    double change;          /* V², of a chip, by which the words found would change what is left */
    bool settled;           /* the words stayed the same in the end */
};

/* What the code points to is kept. NULL: no memory. */
struct detector *detector_new(const struct code *code);
void detector_free(struct detector *detector);

/* Finds words in chips (k, N), V, which are in `next` afterwards. damping: share of the words before that
 * soft ones keep: slower, and more often right. */
void detector_find(struct detector *detector, const float *chips, double damping);

/* Goes on from the words that are taken off, hard ones of the detector's chips, until they stay the same. */
void detector_go_on(struct detector *detector);

/* Levels of all codes in a bit, times the chips per bit. */
static inline float *detector_sums(const struct detector *detector, size_t bit)
{
    return detector->sums + bit * detector->step;
}

#endif
