// SPDX-License-Identifier: Apache-2.0

/* Multiuser detection: which nodes of a sparse book spoke in a frame, and what.
 *
 * Codes are not orthogonal, so that every row holds a part of what every other one has, as noise. It is
 * taken off in turns (approximate message passing: Donoho, Maleki, Montanari 2009): the levels of all rows
 * give the likeliest words, these the chips, and what is left of the frame's chips better levels. A node's k
 * bits decide together whether it spoke, which they do with more noise than any bit could be read in. While
 * much is left, words are soft, and what is left is corrected for having been made of these levels
 * (Onsager's term); then they are hard, with the amplitude that they show. The line's offset is one unknown
 * more.
 *
 * Levels are kept by code number, in the order of the transform, and words only of those who have some, so
 * that what a turn costs beside its two transforms grows with those who speak. */
#ifndef TACTILE_DETECT_H
#define TACTILE_DETECT_H

#include "code.h"

/* Amplitudes are shares of a node's; framing/sparse.py says where each comes from. */
struct detect_rules {
    double least;      /* of a word that is taken off, and noise of a level up to which words are hard */
    double slope;      /* of what tanh rises by, soft bits do, to ±1 */
    double span;       /* of the odds' logarithm, in which the share of a word that is believed rises to 1 */
    double hard;       /* deviations of noise: least mean |r| of a hard word */
    double near;       /* share of what is left by which hard words may differ from soft ones and be final,
                        * and by which less is to be left in the next turn, or words get hard */
    double settled;    /* share of what is left by which amplitudes may change in the end; squared: of A² */
    size_t turns;      /* after which a frame is given up, and pairs of bits that are turned in a bit */
};

/* A book of sparse codes. rows: 2^m. walsh: their transform, unscaled. places: (k, N) of the chips in their
 * bit's 2^m. numbers: (2^m) code number of every row; those of nodes are 1 … n. */
struct sparse_book {
    size_t rows;
    const struct transform *walsh;
    const int32_t *places, *numbers;
    struct detect_rules rules;
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
    struct sparse_book book;
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

/* The code and the book, and what they point to, are kept. NULL: no memory. */
struct detector *detector_new(const struct code *code, const struct sparse_book *book);
void detector_free(struct detector *detector);

/* Finds words in chips (k, N), V, which are in `next` afterwards. damping: share of the words before that
 * soft ones keep: slower, and more often right. */
void detector_find(struct detector *detector, const float *chips, double damping);

/* Finds words in the chips of another detector, from its words on, of which bits are turned, two of a bit at
 * a time, as long as that leaves less. Turns of all words stop where no single bit that is turned leaves
 * less; of few chips two may. alike: (k, 2^m) products of codes i and j, per chip, at i XOR j. */
void detector_turn(struct detector *detector, const struct detector *from, const float *alike);

/* Levels of all codes in a bit, times the chips per bit. */
static inline float *detector_sums(const struct detector *detector, size_t bit)
{
    return detector->sums + bit * detector->step;
}

#endif
