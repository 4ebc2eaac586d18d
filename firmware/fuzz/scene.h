// SPDX-License-Identifier: Apache-2.0

/* A line with a frame of known words, and whatever the input adds to it; and whether what a reader finds there may
 * be. */
#ifndef FUZZ_SCENE_H
#define FUZZ_SCENE_H

#include "frames.h"

/* A frame on a line: where it begins, how long its chips are, and what is known of it. */
struct scene {
    struct frames_book book;
    float sent[FRAMES_MOST_CHIPS]; /* (k, N) what every row holds, V */
    float *volts;
    size_t size, per_chip, gap;
    double start, chip, nominal;
    bool absurd, disturbed, has_raster; /* samples are: NaN, others */
    enum { MARKED, RASTER, ANYWHERE, PROPOSED } timing;
    struct fit known;
};

/* Words, of which a byte of the input each says a bit; a node whose first one is above 127 is silent. Returns how
 * many speak. */
static size_t say(struct scene *scene, struct input *input)
{
    const struct code *code = &scene->book.code;
    size_t speakers = 0;

    for (size_t bit = 0; bit < code->bits; bit++)
        for (size_t node = 0; node < code->nodes; node++) {
            float *word = scene->sent + code->first + node;
            uint8_t byte = input_u8(input);
            bool is_parity = code->parity && bit == code->bits - 1;
            bool is_one = !is_parity && byte % 2, is_silent = bit == 0 ? byte & 128 : *word == 0;
            for (size_t other = 0; is_parity && other < bit; other++)
                is_one ^= word[other * code->order] > 0;
            word[bit * code->order] = is_silent ? 0 : is_one ? 1 : -1;
            speakers += bit == 0 && !is_silent;
        }
    return speakers;
}

/* Samples of the line: a gap, the frame, and what is after; then whatever the input adds. */
static void sample(struct scene *scene, struct input *input, uint8_t kind)
{
    const struct code *code = &scene->book.code;
    const float pedestal = (float)say(scene, input) * (code->unipolar ? 1 : 0);
    const size_t per_chip = scene->per_chip;
    float levels[FRAMES_MOST_CHIPS];

    transform_multiply(code->spread, scene->sent, levels, code->bits);
    for (size_t i = 0; code->flips && i < code->bits * code->order; i++)
        levels[i] *= code->flips[i];
    for (size_t i = 0; i < scene->size; i++)
        scene->volts[i] = 0.24f + 0.01f * (float)((i + kind) * (i + 3) / 8 % 3); /* on no row in particular */
    for (size_t i = 0; i < code->bits * code->order * per_chip; i++) {
        size_t chip = i / per_chip, at = (size_t)code->places[chip] * per_chip + i % per_chip;
        scene->volts[scene->gap + at] += levels[chip] + pedestal;
    }
    scene->absurd = input->left > 0;
    while (input->left) {
        size_t at = input_u16(input) % scene->size;
        uint8_t value = input_u8(input);
        scene->disturbed |= value != 255;
        scene->volts[at] = value == 255 ? NAN : value == 254 ? 1e6f : (float)((int)value - 128) / 8;
    }
}

/* First byte: the code; the second one: how it is sampled, and what is known of its timing. */
static struct scene *make_scene(struct input *input, uint8_t options, uint8_t kind)
{
    struct scene *scene = own(1, sizeof *scene);
    struct code *code = &scene->book.code;
    unsigned twos = 2 + options % 4;
    bool integrated = options & 4, unipolar = options & 8;
    size_t order = (size_t)1 << twos, bits = 4 + input_u8(input) % (FRAMES_MOST_BITS - 3);

    *code = (struct code){.bits = bits, .first = unipolar || kind & 4, .unipolar = unipolar,
                          .scrambled = options & 16 && !unipolar && order > 4, .parity = options & 64,
                          .swing = options & 32 ? NAN : 1};
    code->nodes = 1 + input_u8(input) % (order - code->first);
    scene->timing = integrated ? MARKED : kind / 32 % 4;
    frames_make(&scene->book, twos, options & 128 && !integrated && scene->timing != PROPOSED);
    scene->per_chip = integrated ? 1 : 3 + kind % 3;
    scene->has_raster = scene->timing == RASTER || scene->timing == ANYWHERE;
    size_t gap = 6 * order * scene->per_chip / 10 + input_u8(input);
    scene->gap = scene->has_raster ? gap : 0;
    scene->size = scene->gap + code->span * scene->per_chip + input_u8(input) * scene->per_chip / 4;
    scene->volts = own(scene->size, sizeof *scene->volts);
    scene->start = integrated ? 0 : (double)scene->gap - 0.5;
    scene->chip = (double)scene->per_chip;
    scene->known = (struct fit){scene->start + (kind & 16 ? 0.3 : 0), scene->chip};
    scene->nominal = scene->chip * (scene->timing == PROPOSED ? 0.95 : 1);
    sample(scene, input, kind);
    return scene;
}

/* The word of a node, or its silence, is in no doubt: on an undisturbed line it was sent. */
static void check_sent(const struct scene *scene, size_t node, bool is_heard, int32_t code)
{
    const struct code *sent = &scene->book.code;
    const float *word = scene->sent + sent->first + node;
    int32_t expected = 0;

    for (size_t bit = 0; bit < sent->bits - sent->parity; bit++)
        expected = expected << 1 | (word[bit * sent->order] > 0);
    MUST(scene->disturbed || is_heard == (*word != 0), WRONG_VALUE);
    MUST(scene->disturbed || !is_heard || code == expected, WRONG_VALUE);
}

/* What is beyond a clause's limit is in doubt. */
static void check_read(const struct scene *scene, const struct words *words, const struct frame_found *found)
{
    const struct certificate *certificate = &found->certificate;
    bool any = false, is_sure = certificate_worst(certificate) < 1;
    bool has_edges = scene->book.code.first > 0; /* row 0 has hardly any */

    for (size_t clause = 0; clause < CERTIFICATE_CLAUSES; clause++)
        MUST(!isnan(certificate->value[clause]), WRONG_VALUE);
    for (size_t node = 0; node < scene->book.code.nodes; node++) {
        MUST(words->active[node] <= 1 && words->doubtful[node] <= 1, WRONG_VALUE);
        MUST(is_sure || words->doubtful[node], WRONG_VALUE);
        any |= words->active[node] && !words->doubtful[node] && has_edges;
        if (!words->doubtful[node])
            check_sent(scene, node, words->active[node], words->codes[node]);
    }
    bool is_off = fabs(found->start - scene->start) > 0.3 * scene->chip;
    is_off |= fabs(found->chip - scene->chip) * (double)scene->book.code.span > 0.5 * scene->chip;
    MUST(!any || scene->disturbed || !is_off, WRONG_VALUE);
}

/* Nobody spoke whose words are louder than silence. */
static void check_silence(const struct scene *scene, const struct frame_rules *rules, const struct frame_found *found)
{
    for (size_t node = 0; node < scene->book.code.nodes; node++)
        check_sent(scene, node, false, 0);
    MUST(found->certificate.left * rules->fit.chip <= rules->silent_power, WRONG_VALUE);
}

/* Reads a frame as a stream does: from as many samples as it takes, and those that are asked for. */
static enum frame_verdict read_from(struct frame_reader *reader, const struct scene *scene,
                                 const struct frame_rest *rest, const struct words *words,
                                 struct frame_found *found)
{
    size_t due = frame_reader_due(reader), count = due < scene->size ? due : scene->size;
    bool searches = scene->timing == PROPOSED;

    for (;;) {
        float *volts = malloc(count * sizeof *volts); /* of which none is read beyond */
        memcpy(volts, scene->volts, count * sizeof *volts);
        enum frame_verdict verdict =
            frame_reader_read(reader, volts, count, count == scene->size, searches, rest, words, found);
        free(volts);
        if (verdict == FRAME_NEEDS_MORE) {
            MUST(found->more > 0 && count < scene->size, WRONG_VALUE);
            count = scene->size - count < found->more ? scene->size : count + found->more;
        } else if (verdict == FRAME_SEARCH) {
            MUST(searches, WRONG_VALUE);
            frame_reader_propose(reader, &scene->known);
            searches = false;
        } else
            return verdict;
    }
}

#endif
