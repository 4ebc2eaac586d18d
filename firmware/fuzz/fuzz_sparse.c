// SPDX-License-Identifier: Apache-2.0

/* The driver's detection of sparse codes (kernel/detect.h, sparse.h) on frames of known words, and whatever the input
 * adds to them, any level or none. What is claimed to be taken off, and left over, must add up to the chips in plain
 * sums; few words on an undisturbed line must be those that were sent. */
#include "fuzz.h"
#include "sparse.h"

#include <math.h>

enum { MOST_BITS = 11, MOST_ORDER = 128, MOST_DIGITS = 9, MOST_ROWS = 1 << MOST_DIGITS };
static const unsigned TAPS[][2] = {{5, 2}, {6, 1}, {7, 1}, {MOST_DIGITS, 4}}; /* digits; docs/protocol.md */

static int32_t places[MOST_BITS * MOST_ORDER], codes[MOST_ROWS];
static float flips[MOST_BITS * MOST_ORDER];

/* Fills in the tables of a book; seed: of its flips. */
static void make_book(const struct sparse_book *book, unsigned digits, unsigned tap, uint32_t seed)
{
    int32_t state[MOST_BITS * MOST_ORDER + MOST_DIGITS];

    for (size_t t = 0; t < book->bits * book->order; t++) {
        for (size_t digit = 0; t == 0 && digit < digits; digit++)
            state[digit] = 1 << digit;
        state[t + digits] = state[t] ^ state[t + tap];
        places[t] = state[t];
        seed = seed * 1664525u + 1013904223u;
        flips[t] = seed >> 31 ? 1 : -1;
    }
    for (size_t row = 0; row < book->rows; row++)
        codes[row] = (int32_t)(row * 5 % book->rows);
}

/* A chip of a node, counted from 0. */
static float chip_of(size_t node, size_t at)
{
    return __builtin_parity((unsigned)(codes[node + 1] & places[at])) ? -flips[at] : flips[at];
}

/* A node's level in a bit, of which chips are read so many later; those of other bits are not read. */
static float level_of(const struct sparse_book *book, const float *chips, size_t node, size_t bit, int late)
{
    double sum = 0;

    for (int i = 0; i < (int)book->order; i++)
        if (i + late >= 0 && i + late < (int)book->order) {
            size_t at = bit * book->order + (size_t)i;
            sum += (double)chip_of(node, at) * (double)chips[(ptrdiff_t)at + late];
        }
    return (float)(sum / (double)book->order);
}

/* Words of a frame that settled: one amplitude in all bits, and with what is left and the level all of the chips. */
static void check_sum(const struct sparse_book *book, const float *chips, const struct detected *found)
{
    static float words[MOST_ROWS][MOST_BITS];

    for (size_t bit = 0; bit < book->bits; bit++) {
        for (size_t node = 0; node < book->nodes; node++)
            if (found->heard[node]) {
                words[node][bit] = found->rows[bit * book->rows + node + 1] -
                                   level_of(book, found->left, node, bit, 0);
                MUST(fabsf(fabsf(words[node][bit]) - fabsf(words[node][0])) < 1e-3f, WRONG_VALUE);
            }
        for (size_t at = bit * book->order; at < (bit + 1) * book->order; at++) {
            float sum = found->left[at] + (float)found->level;
            for (size_t node = 0; node < book->nodes; node++)
                sum += found->heard[node] ? words[node][bit] * chip_of(node, at) : 0;
            MUST(fabsf(sum - chips[at]) < 1e-3f, WRONG_VALUE);
        }
    }
}

/* What is certified of an undisturbed line was sent; and its levels are those of who spoke. */
static void check_certified(const struct sparse_book *book, struct sparse *sparse, const float *chips,
                            const int16_t *sent, bool is_sound)
{
    static float levels[MOST_BITS * MOST_ROWS];
    int32_t spoke[MOST_ROWS];
    bool has[MOST_ROWS] = {false};
    struct sparse_told told;
    double noise = 1e-3;

    for (size_t again = 0; again < 2; again++) {
        if (!sparse_read(sparse, chips, &noise, levels, spoke, &told))
            return;
        MUST(told.speakers <= book->nodes && noise >= 0, WRONG_VALUE);
        memset(has, 0, sizeof has);
        for (size_t i = 0; i < told.speakers; i++)
            has[spoke[i]] = true;
        for (size_t node = 0; node < book->nodes; node++)
            MUST(!is_sound || has[node] == (sent[node] >= 0), WRONG_VALUE);
        for (size_t i = 0; is_sound && i < book->bits * told.speakers; i++)
            MUST((levels[i] > 0) == (sent[spoke[i % told.speakers]] >> i / told.speakers & 1), WRONG_VALUE);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    struct input input = {bytes, size};
    const unsigned *taps = TAPS[input_u8(&input) % 4];
    size_t rows = (size_t)1 << taps[0], longest = rows - 1 < MOST_ORDER ? rows - 1 : MOST_ORDER;
    size_t bits = 2 + input_u8(&input) % (MOST_BITS - 1), order = 8 + input_u8(&input) % (longest - 7);
    size_t nodes = 1 + input_u16(&input) % (rows - 1), speakers = input_u8(&input) % (order / 2);
    struct transform *walsh = transform_new(taps[0], 0, NULL, NULL, 1, 0);
    const struct sparse_book book = {bits, order, rows, nodes, walsh, places, codes, flips};
    const struct sparse_rules rules = {
        .detect = {.swing = 1, .least = 0.35, .soft_noise = 0.1, .slope = 0.75, .log_odds = 8, .hard_share = 2.2,
                   .settled = 0.01, .near = 0.1, .negligible = 1e-4, .stalled = 0.97, .turns = 24},
        .capacity = nodes < order / 4 ? nodes : order / 4, .most_noise = 0.1 * (double)order, .more = 0.1,
        .tolerance = 0.03, .faintest = 0.56, .chance = 4 * sqrt(2.0 / (double)(bits * order)), .chance_of_bit = 4 * sqrt(2.0 / (double)order),
        .hiding = 0.7 * sqrt((double)order / 8), .weight = 0.25, .silent_square = 0.01 * (double)bits, .silent_power = 2.5 * (double)bits,
        .alike = true};
    const double dampings[] = {0, 0.6, 0.8};
    int16_t sent[MOST_ROWS];
    bool is_sound = true;
    uint8_t heard[MOST_ROWS];
    static float chips[MOST_BITS * MOST_ORDER], left[MOST_BITS * MOST_ORDER], levels[MOST_BITS * MOST_ROWS];
    float loudness[MOST_ROWS];
    double power[MOST_BITS], damping = dampings[input_u8(&input) % 3];
    int late = input_u8(&input) % 15 - 7;

    make_book(&book, taps[0], taps[1], input_u16(&input));
    memset(sent, -1, sizeof sent);
    for (size_t i = 0; i < speakers; i++) {
        size_t node = input_u16(&input) % nodes;
        sent[node] = (int16_t)(input_u16(&input) % (1 << bits));
    }
    for (size_t at = 0; at < bits * order; at++) {
        chips[at] = 0.25f;
        for (size_t node = 0; node < nodes; node++)
            if (sent[node] >= 0)
                chips[at] += sent[node] >> at / order & 1 ? chip_of(node, at) : -chip_of(node, at);
    }
    while (input.left) {
        size_t at = input_u16(&input) % (bits * order);
        uint8_t byte = input_u8(&input);
        chips[at] += byte == 128 ? NAN : byte == 127 ? INFINITY : (float)(int8_t)byte * 0.01f;
        is_sound = false;
    }

    struct sparse *sparse = sparse_new(&book, &rules);
    struct detected found = {.rows = levels, .left = left, .heard = heard, .power = power};
    detector_detect(sparse_detector(sparse), chips, damping, &found);
    if (found.settled)
        check_sum(&book, chips, &found);
    for (size_t bit = 0; bit < bits; bit++)
        MUST(!(power[bit] < 0), WRONG_VALUE);
    if (is_sound && found.settled && bits >= 8 && order >= 64 && speakers <= order / 8)
        for (size_t node = 0; node < nodes; node++) {
            MUST(heard[node] == (sent[node] >= 0), WRONG_VALUE);
            for (size_t bit = 0; heard[node] && bit < bits; bit++)
                MUST((levels[bit * rows + node + 1] > 0) == (sent[node] >> bit & 1), WRONG_VALUE);
        }
    check_certified(&book, sparse, chips, sent, is_sound && bits >= 8 && order >= 16);
    detector_loudness(sparse_detector(sparse), chips, late, loudness);
    for (size_t node = 0; node < nodes; node += 1 + nodes / 8) {
        float mean = 0;
        for (size_t bit = 0; bit < bits; bit++)
            mean += fabsf(level_of(&book, chips, node, bit, late)) / (float)bits;
        MUST(!(fabsf(loudness[node] - mean) > 1e-3f), WRONG_VALUE);
    }
    sparse_free(sparse);
    transform_free(walsh);
    return 0;
}
