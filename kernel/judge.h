// SPDX-License-Identifier: Apache-2.0

/* Weighs a frame against its rivals, which begin whole chips earlier or later: the chips' bounded votes of
 * framing/judge.py. In C because every frame of a line without marks has some eight rivals, of which each takes two
 * transforms and ten passes over its chips: numpy would take longer for that than for all the rest. */
#ifndef TACTILE_JUDGE_H
#define TACTILE_JUDGE_H

#include "fit.h"

#define JUDGE_MOST 16 /* frames that are weighed: _MOST_CARRIED in search.py */

/* As `Limits` in limits.py. */
struct judge_limits {
    double distortion, most, most_deviations, vote;
};

/* What words a frame holds; as WordFit of one candidate. */
struct judge_words {
    float *rows, *amplitude, *uneven, *pedestal, *power, *spread, *misfit;
};

/* A frame and its rivals, `count` in all, of which number c begins with chip c of the view: the frame is number
 * `likely`. levels: of count - 1 chips more than a frame has. noise: of a chip's level in the gap, V². */
struct judge_view {
    size_t count, likely;
    const float *levels;
    double noise;
};

/* How chips vote: δ, V, and σ², V². */
struct judge_votes {
    double distortion, variance;
};

/* Values of scratch that JUDGE_MOST frames take. */
size_t judge_scratch(const struct fit_code *code);

/* cost: (count), negative log-likelihood. Rivals whose last bits cost more than the frame and `margin` are ruled out,
 * and keep the cost of these; so are those that by these leave more over, beyond `close`. votes: what the line gives.
 * False where a rival leaves less over than the frame: then chips would vote by that one. */
bool judge_weigh(const struct fit_code *code, const struct judge_limits *limits, const struct judge_view *view,
                 const struct judge_words *words, double close, double margin, struct judge_votes *votes, double *cost,
                 float *scratch);

/* As Votes.most in judge.py; disturbed: share of the chips that may be. */
double judge_most(const struct judge_limits *limits, double disturbed, const struct judge_votes *votes, size_t chips);

#endif
