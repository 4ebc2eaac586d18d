// SPDX-License-Identifier: Apache-2.0

/* Weighs candidate frames against each other: the chips' bounded votes of framing/judge.py. In C because
 * every frame has some nine candidates, of which each takes two transforms and ten passes over its chips:
 * numpy would take longer for that than for all the rest. Candidates a whole chip apart share their chips'
 * levels. */
#ifndef TACTILE_JUDGE_H
#define TACTILE_JUDGE_H

#include "fit.h"

/* As `Limits` in limits.py; blur: see fit.py. */
struct judge_limits {
    double distortion, most, most_deviations, vote, blur;
};

/* c candidates, and the line from `begin` to `end`. likely: which one it probably is; of the others those are
 * left after their last bits whose cost is beyond its one and `margin` by these, or `close` if by these they
 * leave more over. As many as there are: of all the whole cost is wanted. levels: of the chips in view of the likely
 * one, whose words are found already; or NULL. */
struct judge_candidates {
    size_t count, likely;
    const double *start, *chip;
    double begin, end, margin, close;
    float *levels;
};

/* What is found out of each candidate: rows (c, k, N); amplitude, uneven (c, n); the others (c,), as in
 * WordFit. cost: negative log-likelihood; of those that are left, that of their last bits, and nothing is
 * meant by their words. */
struct judge_found {
    float *rows, *amplitude, *uneven, *pedestal, *power, *spread, *misfit;
    double *cost;
};

/* How chips vote: δ, V, and σ², V². */
struct judge_votes {
    double distortion, variance;
};

/* Chips of the longest view among the candidates; 0 where one is not within the view. */
size_t judge_chips(const struct fit_code *code, const struct judge_candidates *candidates);

/* Values of scratch that these take. */
size_t judge_scratch(const struct fit_code *code, const struct judge_candidates *candidates);

/* Fills in what is found. votes: found out, too, where their variance is 0; noise: of a chip's level in the
 * gap, V². */
void judge_weigh(const struct fit_code *code, const struct fit_line *line,
                 const struct judge_limits *limits, const struct judge_candidates *candidates,
                 double noise, const struct judge_found *found, struct judge_votes *votes,
                 float *scratch);

/* As Votes.most in judge.py; disturbed: share of the chips that may be. */
double judge_most(const struct judge_limits *limits, double disturbed, const struct judge_votes *votes,
                  size_t chips);

#endif
