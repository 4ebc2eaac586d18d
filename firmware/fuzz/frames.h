// SPDX-License-Identifier: Apache-2.0

/* Frames as the driver has them read: small codes, and rules and limits as framing/frame_reader.py and
 * words/limits.py give them. */
#ifndef FUZZ_FRAMES_H
#define FUZZ_FRAMES_H

#include "frame_reader.h"
#include "fuzz.h"

#include <math.h>

enum { FRAMES_MOST_BITS = 11, FRAMES_MOST_ORDER = 32 };
enum { FRAMES_MOST_CHIPS = FRAMES_MOST_BITS * FRAMES_MOST_ORDER };

static const struct certificate_limits FRAMES_LIMITS = {
    .words = {5, 0.4f, 0.65f, 16, 1.6f, 1.25f, 6.7f, 0.5f},
    .deviations = 4.0128, .log_odds = 12.414, .left = 0.1, .left_of_word = 0.09, .bit = 2.5, .chip = 0.7,
    .leak = 0.35, .atom = 0.33, .row = 0.2, .faint = 0.1, .faint_bit = 0.25, .faint_deviations = 3.3,
    .better = 0.25, .edges = 0.3, .few = 12, .beside = 0.4, .moves = 0.283, .silent_rho = 10, .hidden = 0.04,
    .weak = 0.8, .loud_share = 0.25, .unknown_noise = 6, .uneven = 0.25};

/* A code, and what it points to. */
struct frames_book {
    struct code code;
    struct transform *correlate, *spread;
    float flips[FRAMES_MOST_CHIPS];
    int32_t places[FRAMES_MOST_CHIPS], sign_mask[FRAMES_MOST_ORDER];
    struct code_twin twins[3 * 4 * FRAMES_MOST_ORDER]; /* three at most of a row are alike to another */
};

/* Σ sent[i + shift]·alike[i] / N of two rows within a bit, and over the chips of the next one. */
static inline void frames_add_twin(struct frames_book *book, unsigned sent, unsigned alike, int shift)
{
    struct code *code = &book->code;
    int order = (int)code->order, first = (int)code->first;
    float sums[2] = {0};

    for (int i = 0; i < order; i++) {
        unsigned from = (unsigned)(i + shift + order) % (unsigned)order;
        bool is_odd = __builtin_parity((sent & from) ^ (alike & (unsigned)i));
        sums[i + shift < 0 || i + shift >= order] += is_odd ? -1.0f : 1.0f;
    }
    if (fabsf(sums[0]) > 0.5f * (float)order && (sent != alike || sums[0] < 0))
        book->twins[code->twin_count++] = (struct code_twin){(int)sent - first, (int)alike - first, shift,
                                                             sums[0] / (float)order, sums[1] / (float)order};
}

/* Makes a book of 2^twos rows, of which the code's bits, nodes and first row are set, and its flags.
 * pause: chips between two bits. */
static inline void frames_make(struct frames_book *book, unsigned twos, size_t pause)
{
    struct code *code = &book->code;
    const size_t order = code->order = (size_t)1 << twos;
    uint32_t seed = 7;

    code->correlate = book->correlate = transform_new(twos, 0, NULL, NULL, 1.0f / (float)order, 0);
    code->spread = book->spread = transform_new(twos, 0, NULL, NULL, 1, 0);
    code->span = code->bits * order + (code->bits - 1) * pause;
    code->spare = code->first + code->nodes;
    code->spare_count = order - code->spare;
    code->active_share = 0.5f;
    code->flips = code->scrambled ? book->flips : NULL;
    code->places = book->places;
    code->sign_mask = book->sign_mask;
    code->twins = book->twins;
    for (size_t i = 0; i < code->bits * order; i++) {
        seed = seed * 1664525u + 1013904223u;
        book->flips[i] = seed >> 31 ? 1 : -1;
        book->places[i] = (int32_t)(i + i / order * pause);
    }
    for (int shift = -2; shift <= 2 && !code->scrambled; shift++)
        for (unsigned sent = 0; shift && sent < code->nodes; sent++)
            for (unsigned alike = 0; alike < code->nodes; alike++)
                frames_add_twin(book, sent + (unsigned)code->first, alike + (unsigned)code->first, shift);
}

static inline void frames_free(struct frames_book *book)
{
    transform_free(book->correlate);
    transform_free(book->spread);
}

/* chip: samples; 1: they are means of chips. side: chips beside a frame that are looked at. */
static inline struct frame_rules frames_rules(const struct code *code, double chip, size_t side, double rail)
{
    static const double reaches[] = {0.5, 0.5, 0.25, 0.12};
    const bool integrated = chip == 1, known = !isnan(code->swing);
    const double swing = known ? (double)code->swing : 0, order = (double)code->order;

    return (struct frame_rules){
        .integrated = integrated, .mean_is_offset = (code->first > 0 || code->scrambled) && !code->unipolar,
        .searches = !integrated && code->span == code->bits * code->order,
        .size = integrated ? code->bits * code->order : (size_t)ceil((double)code->span * chip - 0.5),
        .tail = 3, .rail_low = -rail,
        .rail_high = rail, .silent_power = 0.01 * swing * swing,
        .silent_chip = 0.4 * swing, .most_noise = known ? swing * sqrt(order) / 2.5 : (double)INFINITY,
        .deafened = 0.25, .clipped = 0.5, .kept = 0.67, .misfit = 0.5,
        .fit = {.chip = chip, .least_chip = 0.99 * chip, .most_chip = 1.01 * 1.11 * chip, .earliest = -1, .latest = 0.5,
                .side = side, .refined = 3e-3, .searched = 0.1, .tied = 0.01, .blur = 0.3, .settled_chips = 0.02, .turns = 4,
                .reaches = reaches}};
}

#endif
