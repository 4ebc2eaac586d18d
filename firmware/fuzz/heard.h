// SPDX-License-Identifier: Apache-2.0

/* Words of any levels, compared with what these are one by one. */
#ifndef FUZZ_HEARD_H
#define FUZZ_HEARD_H

#include "frames.h"

/* A level: a number of the input, or none. */
static float level_of(uint8_t byte)
{
    return byte == 128 ? NAN : byte == 127 ? INFINITY : (float)(int8_t)byte * 0.01f;
}

/* Nodes whose words have been read, from k rows of n levels; and the shape of a word. */
struct heard {
    struct code code;
    struct words words;
    struct words_measures measures;
    float *expected, *rows;
};

static struct heard heard_new(size_t bits, size_t nodes, bool parity, float swing)
{
    int32_t *sign_mask = own(nodes, sizeof *sign_mask);
    struct words words = words_in(own(nodes, WORDS_BYTES), nodes);
    struct words_measures measures = {words.amplitude, own(nodes, 4), own(nodes, 4),
                                      own(nodes, 4),   own(nodes, 4), own(nodes, 4)};
    struct heard heard = {{.nodes = nodes, .bits = bits, .parity = parity, .sign_mask = sign_mask}, words, measures,
                          own(nodes, 4), own(bits * nodes, 4)};

    for (size_t i = 0; i < nodes; i++) {
        heard.expected[i] = swing;
        sign_mask[i] = i % 2 ? 0 : (int32_t)((1u << bits) - 1);
    }
    return heard;
}

/* The word of a node as it was read, from its levels, one by one. */
static void check_word(const struct heard *heard, size_t i)
{
    const struct words *words = &heard->words;
    const size_t bits = heard->code.bits, nodes = heard->code.nodes;
    uint32_t word = 0;
    double sum = 0;

    for (size_t bit = 0; bit < bits; bit++) {
        float level = heard->rows[bit * nodes + i];
        word = word << 1 | (level > 0);
        sum += fabs((double)level);
    }
    word ^= (uint32_t)heard->code.sign_mask[i];
    double mean = sum / (double)bits;
    MUST(!(fabs((double)words->amplitude[i] - mean) > 1e-5 * mean), WRONG_VALUE);
    MUST(words->doubtful[i] <= words->active[i] && words->doubled[i] <= words->doubtful[i], WRONG_VALUE);
    MUST(words->odd[i] == (heard->code.parity && words->active[i] && __builtin_parity(word)), WRONG_VALUE);
    MUST(words->odd[i] <= words->doubtful[i], WRONG_VALUE);
    if (!words->active[i])
        MUST(!words->codes[i], WRONG_VALUE);
    else if (!words->odd[i])
        MUST((uint32_t)words->codes[i] == word >> heard->code.parity, WRONG_VALUE);
    else
        MUST((uint32_t)words->codes[i] >> (bits - 1) == 0, WRONG_VALUE);
}

/* The words of the levels at hand. */
static void hear(struct heard *heard)
{
    const size_t nodes = heard->code.nodes;
    struct words *words = &heard->words;
    float loudest;

    words_measure(heard->rows, nodes, heard->code.bits, nodes, &heard->measures);
    float usual = words_usual(words->amplitude, nodes, 0.25f, &loudest);
    MUST(!(usual > loudest), WRONG_VALUE);
    for (size_t i = 0; i < nodes; i++) {
        MUST(!(words->amplitude[i] > loudest), WRONG_VALUE);
        words->active[i] = words->amplitude[i] > 0.5f * heard->expected[i];
        words->faint[i] = !words->active[i] && i % 3 == 0;
    }
    words_decide(&heard->measures, &heard->code, heard->expected, 100, &FRAMES_LIMITS.words, words);
    for (size_t i = 0; i < nodes; i++)
        check_word(heard, i);
}

#endif
