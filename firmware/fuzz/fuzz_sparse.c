// SPDX-License-Identifier: Apache-2.0

/* The driver's detection of sparse codes (kernel/detect.h, sparse.h) on frames of known words, and whatever
 * the input adds to them, any level or none. What is claimed to be taken off, and left over, must add up to
 * the chips in plain sums; few words on an undisturbed line, and whatever is certain there, must be what was
 * sent. */
#include "frames.h"
#include "sparse.h"

enum { MOST_BITS = 11, MOST_ORDER = 128, MOST_DIGITS = 9, MOST_ROWS = 1 << MOST_DIGITS };
static const unsigned TAPS[][2] = {{5, 2}, {6, 1}, {7, 1}, {MOST_DIGITS, 4}}; /* digits; docs/protocol.md */

static int32_t places[MOST_BITS * MOST_ORDER], numbers[MOST_ROWS];
static float flips[MOST_BITS * MOST_ORDER];

/* Fills in the tables of a book; seed: of its flips. */
static void make_book(const struct code *code, unsigned digits, unsigned tap, uint32_t seed)
{
    const size_t rows = (size_t)1 << digits;
    int32_t state[MOST_BITS * MOST_ORDER + MOST_DIGITS];

    for (size_t t = 0; t < code->bits * code->order; t++) {
        for (size_t digit = 0; t == 0 && digit < digits; digit++)
            state[digit] = 1 << digit;
        state[t + digits] = state[t] ^ state[t + tap];
        places[t] = state[t];
        seed = seed * 1664525u + 1013904223u;
        flips[t] = seed >> 31 ? 1 : -1;
    }
    for (size_t row = 0; row < rows; row++)
        numbers[row] = (int32_t)(row * 5 % rows);
}

/* A chip of a node, counted from 0. */
static float chip_of(size_t node, size_t at)
{
    return __builtin_parity((unsigned)(numbers[node + 1] & places[at])) ? -flips[at] : flips[at];
}

/* Words that were found: of nodes, and with what is left and the offset all of the chips. */
static void check_sum(const struct detector *detector, const float *chips)
{
    const struct listed *taken = &detector->now;
    const size_t order = detector->code.order;

    for (size_t i = 0; i < taken->count; i++)
        MUST(detector->nodes[taken->codes[i]] >= 0, WRONG_VALUE);
    for (size_t at = 0; at < detector->code.bits * order; at++) {
        float sum = detector->left[at] * flips[at] + (float)detector->offset;
        for (size_t i = 0; i < taken->count; i++) {
            float word = taken->words[at / order * detector->book->rows + i];
            sum += word * chip_of((size_t)detector->nodes[taken->codes[i]], at);
        }
        MUST(fabsf(sum - chips[at]) < 1e-3f, WRONG_VALUE);
    }
}

/* The words found are those that were sent. */
static void check_found(const struct detector *detector, const int16_t *sent)
{
    const struct listed *found = &detector->next;
    size_t speakers = 0;

    for (size_t node = 0; node < detector->code.nodes; node++)
        speakers += sent[node] >= 0;
    MUST(found->count == speakers, WRONG_VALUE);
    for (size_t i = 0; i < found->count; i++)
        for (size_t bit = 0; bit < detector->code.bits; bit++) {
            int16_t word = sent[detector->nodes[found->codes[i]]];
            bool is_one = found->words[bit * detector->book->rows + i] > 0;
            MUST(word >= 0 && is_one == (word >> bit & 1), WRONG_VALUE);
        }
}

/* What is certain on an undisturbed line was sent; elsewhere flags are 0 or 1. */
static void check_words(const struct code *code, const struct words *words, const int16_t *sent,
                        bool is_sound)
{
    for (size_t node = 0; node < code->nodes; node++) {
        int32_t word = 0;
        for (size_t bit = 0; sent[node] >= 0 && bit < code->bits; bit++)
            word |= (sent[node] >> bit & 1) << (code->bits - 1 - bit);
        MUST(words->active[node] <= 1 && words->doubtful[node] <= 1 && words->faint[node] <= 1, WRONG_VALUE);
        if (is_sound && !words->doubtful[node])
            MUST(words->active[node] == (sent[node] >= 0) && words->codes[node] == word, WRONG_VALUE);
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
    const struct sparse_code sparse_code = {
        .rows = rows, .walsh = walsh, .places = places, .numbers = numbers, .least = 0.1, .slope = 0.75, .span = 8,
        .hard = 2.2, .near = 0.1, .settled = 0.01, .turns = 24,
        .capacity = nodes < order / 4 ? nodes : order / 4, .hidden = 0.5, .damping = 0.6, .faintest = 0.56,
        .may_cancel = true};
    static const int32_t sign_mask[MOST_ROWS];
    const struct code code = {.bits = bits, .order = order, .nodes = nodes, .first = 1, .span = bits * order,
                              .scrambled = true, .swing = 1, .active_share = 0.5f, .flips = flips,
                              .sign_mask = sign_mask, .sparse = &sparse_code};
    struct certificate_limits limits = FRAMES_LIMITS;
    int16_t sent[MOST_ROWS];
    bool is_sound = true;
    static float chips[MOST_BITS * MOST_ORDER], expected[MOST_ROWS];
    static _Alignas(float) uint8_t memory[WORDS_BYTES * MOST_ROWS];
    const struct words words = words_in(memory, nodes);
    double damping = input_u8(&input) % 2 ? 0.6 : 0;

    limits.left_of_word = 0.03;
    limits.bit = 1;
    make_book(&code, taps[0], taps[1], input_u16(&input));
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

    struct detector *detector = detector_new(&code);
    detector_find(detector, chips, damping);
    if (detector->settled)
        check_sum(detector, chips);
    if (is_sound && detector->settled && bits >= 8 && order >= 64 && speakers <= order / 8)
        check_found(detector, sent);
    detector_free(detector);

    for (size_t node = 0; node < nodes; node++)
        expected[node] = 1;
    struct sparse *sparse = sparse_new(&code, &limits, expected);
    struct certificate_view view = {.chips = chips, .noise_v2 = 1e-3};
    struct certificate certificate;
    for (size_t again = 0; again < 2; again++) {
        sparse_read(sparse, &view, &words, &certificate);
        MUST(certificate.speakers <= nodes, WRONG_VALUE);
        bool is_sure = certificate_worst(&certificate) < 1;
        check_words(&code, &words, sent, is_sound && is_sure && bits >= 8 && order >= 16);
    }
    sparse_free(sparse);
    transform_free(walsh);
    return 0;
}
