// SPDX-License-Identifier: Apache-2.0

/* The driver's compiled kernel (kernel/): arbitrary bytes through its scanner and a reference reader,
 * whole numbers through its transforms and sums without any trick, any levels read as words, and frames
 * looked for without marks. What follows a stream has a harness of its own, fuzz_stream.c. */
#include "contacts.h"
#include "gap.h"
#include "reference.h"
#include "readout.h"
#include "marked_frame.h"
#include "scanner.h"
#include "transform.h"
#include "words.h"

#include <math.h>

#define MOST_ORDER 1024

/* A sample by docs/protocol.md: a word, or 12 bits from half byte 3·i on. */
static int sample_of(const struct scanner_packet *packet, size_t i)
{
    struct tp_packed head;

    if (packet->type == TP_SAMPLES) {
        int16_t word;
        memcpy(&word, packet->payload + sizeof(struct tp_samples) + 2 * i, sizeof word);
        return (int16_t)(word ^ 0x5555);
    }
    memcpy(&head, packet->payload, sizeof head);
    const uint8_t *at = packet->payload + sizeof head + 3 * i / 2;
    int value = i % 2 ? at[0] >> 4 | at[1] << 4 : at[0] | (at[1] & 15) << 8;
    int sample = head.base + (value ^ 0x555) * head.step;
    MUST(sample >= INT16_MIN && sample <= INT16_MAX, WRONG_VALUE);
    return sample;
}

/* What the scanner finds in bytes, in pieces of a size; size 0: at once. */
static struct scanner_counts scan(const uint8_t *bytes, size_t size, size_t piece, bool compare)
{
    static uint8_t body[FRAMING_MAX_RUN];
    struct scanner *scanner = scanner_new(3);
    struct scanner_counts counts;
    size_t begin = 0, end = 0;

    for (size_t done = 0; done < size;) {
        struct scanner_packet packet;
        size_t left = size - done, some = piece && piece < left ? piece : left;
        size_t taken = scanner_take(scanner, bytes + done, some, &packet);
        MUST(taken && taken <= some, WRONG_VALUE);
        done += taken;
        MUST(scanner_held(scanner) <= FRAMING_MAX_RUN, WRONG_VALUE);
        if (!compare || !packet.payload)
            continue;
        size_t found = 0; /* the last run before `done` is this packet */
        for (; end < done; end++)
            if (!bytes[end]) {
                found = framing_unwrap(bytes + begin, end - begin, body);
                begin = end + 1;
            }
        struct tp_header header;
        memcpy(&header, body, sizeof header);
        MUST(found == packet.size + sizeof header, WRONG_VALUE);
        MUST(header.type == packet.type && header.sequence == packet.sequence, WRONG_VALUE);
        MUST(!memcmp(body + sizeof header, packet.payload, packet.size), WRONG_VALUE);
        size_t samples = scanner_samples(&packet);
        uint16_t *words = malloc(samples * sizeof *words);
        struct tp_samples head;
        if (samples)
            scanner_copy_samples(&packet, &head, words);
        for (size_t i = 0; i < samples; i++)
            MUST((int16_t)words[i] == sample_of(&packet, i), WRONG_VALUE);
        free(words);
    }
    scanner_counts(scanner, &counts);
    scanner_free(scanner);
    return counts;
}

static void scan_in_pieces(const uint8_t *bytes, size_t size, size_t piece)
{
    struct scanner_counts counts = scan(bytes, size, 0, true), other = scan(bytes, size, piece, false);
    static uint8_t body[FRAMING_MAX_RUN];
    size_t begin = 0;
    uint64_t runs = 0, whole = 0;

    MUST(!memcmp(&counts, &other, sizeof counts), UNCOUNTED_LOSS);
    for (size_t i = 0; i < size; i++)
        if (!bytes[i]) {
            runs += i > begin;
            whole += framing_unwrap(bytes + begin, i - begin, body) > 0;
            begin = i + 1;
        }
    uint64_t broken = counts.crc_errors + counts.framing_errors + counts.resyncs;
    if (size - begin <= FRAMING_MAX_RUN) /* else a run without end counts, too */
        MUST(runs == counts.packets + broken, UNCOUNTED_LOSS);
    MUST(whole == counts.packets - counts.malformed, UNCOUNTED_LOSS);
    MUST(counts.bytes == size, UNCOUNTED_LOSS);
}

/* The input, or so many copies of it and a delimiter: more than the longest packet. */
static void scan_bytes(struct input *input)
{
    size_t piece = 1 + input_u8(input), copies = 1 + input_u8(input) % 8;
    size_t size = input->left * copies + (copies > 1);
    uint8_t *bytes = malloc(size + !size);

    for (size_t i = 0; i < copies; i++)
        memcpy(bytes + i * input->left, input->bytes, input->left);
    if (copies > 1)
        bytes[size - 1] = 0;
    scan_in_pieces(bytes, size, piece);
    free(bytes);
}

/* Bodies of the input as packets, one after the other. */
static void scan_packets(struct input *input)
{
    static uint8_t wire[1 << 14], body[2048];
    size_t size = 0, piece = 1 + input_u8(input);

    while (input->left && size + 1100 < sizeof wire) {
        const uint8_t *bytes;
        size_t some = input_bytes(input, &bytes, input_u16(input) % 1024);
        memcpy(body, bytes, some);
        size += framing_wrap(body, some, wire + size);
    }
    uint8_t *exact = malloc(size + !size);
    memcpy(exact, wire, size);
    scan_in_pieces(exact, size, piece);
    free(exact);
}

/* The sign with which input i adds to output j. */
static int sign(unsigned twos, size_t count, const size_t *orders, int8_t *const *matrices, size_t j,
                size_t i)
{
    int product = 1;

    while (count-- > 0) {
        size_t order = orders[count];
        product *= matrices[count][j % order * order + i % order];
        j /= order;
        i /= order;
    }
    (void)twos;
    for (; i && j; i /= 2, j /= 2)
        product = i & j & 1 ? -product : product;
    return product;
}

/* Whole numbers below 2²⁴ are exact in float32: the result must be that of the plain sum. */
static void transform(struct input *input)
{
    unsigned twos = input_u8(input) % 11, asked = input_u8(input), lanes = asked % 16;
    size_t count = input_u8(input) % 4, orders[4], order = (size_t)1 << twos;
    int8_t *matrices[4];

    for (size_t f = 0; f < count; f++) {
        orders[f] = input_u8(input) % 130;
        matrices[f] = malloc(orders[f] * orders[f] + 1);
        for (size_t i = 0; i < orders[f] * orders[f]; i++)
            matrices[f][i] = input->left ? (int8_t)((int)(input_u8(input) % 2) * 2 - 1) : 1;
        order *= orders[f];
    }
    struct transform *made =
        transform_new(twos, count, orders, (const int8_t *const *)matrices, 1.0f, lanes);
    if (made && order <= MOST_ORDER) {
        size_t vectors = 1 + asked / 16 % 5, values = vectors * order;
        float *from = malloc(values * sizeof *from), *to = malloc(values * sizeof *to);
        MUST(transform_order(made) == order, WRONG_VALUE);
        for (size_t i = 0; i < values; i++)
            from[i] = (int8_t)input_u8(input);
        transform_multiply(made, from, to, vectors);
        for (size_t place = 0; place < values; place += 1 + values / 64) {
            const float *vector = from + place / order * order;
            long sum = 0;
            for (size_t i = 0; i < order; i++)
                sum += sign(twos, count, orders, matrices, place % order, i) * (long)vector[i];
            MUST(to[place] == (float)sum, WRONG_VALUE);
        }
        transform_multiply(made, from, from, vectors);
        MUST(!memcmp(from, to, values * sizeof *from), WRONG_VALUE);
        free(from);
        free(to);
    }
    transform_free(made);
    for (size_t f = 0; f < count; f++)
        free(matrices[f]);
}

/* A level: a number of the input, or none. */
static float level_of(uint8_t byte)
{
    return byte == 128 ? NAN : byte == 127 ? INFINITY : (float)(int8_t)byte * 0.01f;
}

/* Words of candidates, and those that are late, of any levels. */
static void fit_words(struct input *input)
{
    size_t bits = 1 + input_u8(input) % 17, nodes = 1 + input_u16(input) % 300;
    size_t first = input_u8(input) % 4, order = first + nodes + input_u8(input) % 40;
    bool unipolar = input_u8(input) % 2;
    float swing = level_of(input_u8(input));
    float *rows = malloc(bits * order * sizeof *rows), *floats = malloc(2 * nodes * sizeof *floats);
    float *meant = malloc(order * sizeof *meant), *edges = malloc(4 * order * sizeof *edges);
    uint8_t *late = malloc(nodes);
    float pedestal, power, spread, misfit;
    const struct words_frame frame = {bits, order, first, nodes, unipolar, swing, 0.25f, 0.5f, 2.2};
    const struct words_lateness lateness = {0.35f, 5, 1.07f};

    for (size_t i = 0; i < bits * order; i++)
        rows[i] = level_of(input_u8(input));
    words_fit(&frame, rows, floats, floats + nodes, &pedestal, &power, &spread, &misfit);
    for (size_t i = 0; i < nodes; i++)
        MUST(!(floats[i] < 0), WRONG_VALUE);
    for (size_t i = 0; i < order; i++)
        meant[i] = i % 3 ? swing : 0;
    for (size_t i = 0; i < 4 * order; i++)
        edges[i] = i % 5 ? 1 : -1;
    if (bits > 1 && order > 4) {
        words_late(&frame, rows, meant, edges, &lateness, late);
        for (size_t i = 0; i < nodes; i++)
            MUST(late[i] <= (meant[first + i] > 0), WRONG_VALUE);
    }
    free(rows);
    free(floats);
    free(meant);
    free(edges);
    free(late);
}

/* Samples of any level, and edges of any kind. */
static void add_samples(struct input *input)
{
    size_t size = 1 + input_u16(input) % 400, edges = 1 + input_u8(input), chips = input_u8(input) % edges;
    int16_t *counts = malloc(size * sizeof *counts);
    float *levels = malloc((chips + 1) * sizeof *levels), zero = (float)(int16_t)input_u16(input);
    float *volts = malloc(size * sizeof *volts);
    double *spans = malloc(2 * edges * sizeof *spans);
    int32_t *whole = malloc((edges + chips) * sizeof *whole), at = 0;
    double sum = 0;
    size_t outside = 0;

    for (size_t i = 0; i < size; i++)
        counts[i] = (int16_t)input_u16(input);
    samples_volts(counts, size, zero, 0.5f, 20000, volts);
    for (size_t i = 0; i < size; i++) {
        float level = ((float)counts[i] - zero) * 0.5f;
        MUST(isnan(volts[i]) ? fabsf(level) >= 20000 : volts[i] == level, WRONG_VALUE);
        outside += volts[i] <= -100 || volts[i] >= 100;
        sum += (double)volts[i];
    }
    MUST(samples_outside(volts, size, -100, 100) == outside, WRONG_VALUE);
    struct samples_sums sums = samples_add(volts, size);
    MUST(isnan(sum) ? isnan(sums.sum) : sums.sum == sum && !(sums.squares < 0), WRONG_VALUE);
    for (size_t edge = 0; edge < edges; edge++) {
        at += (int8_t)(input_u8(input) % 32) - 1;
        whole[edge] = at;
        spans[edge] = input_u8(input) / 255.0;
        spans[edges + edge] = 1 + input_u8(input);
    }
    for (size_t chip = 0; chip < chips; chip++)
        whole[edges + chip] = input_u8(input);
    struct samples_edges all = {edges, whole, spans, spans + edges};
    samples_chips(volts, size, 1, &all, whole + edges, chips, levels);
    free(counts);
    free(volts);
    free(levels);
    free(spans);
    free(whole);
}

/* A word of a frame as it was read, from its levels, one by one. */
static void check_word(const struct readout_settings *settings, const struct readout_skin *skin,
                       const struct readout_frame *found, const float *rows, size_t i)
{
    const struct words_frame *frame = &settings->frame;
    uint32_t word = 0;
    double sum = 0;

    for (size_t bit = 0; bit < frame->bits; bit++) {
        float level = rows[bit * frame->order + frame->first + i];
        word = word << 1 | (level > 0);
        sum += fabs((double)level);
    }
    word ^= (uint32_t)skin->sign_mask[i];
    double mean = sum / (double)frame->bits;
    MUST(!(fabs((double)found->amplitude[i] - mean) > 1e-5 * mean), WRONG_VALUE);
    MUST(found->active[i] == (found->amplitude[i] > settings->reading.threshold * skin->expected[i]),
         WRONG_VALUE);
    MUST(found->doubtful[i] <= found->active[i] && found->doubled[i] <= found->doubtful[i], WRONG_VALUE);
    MUST(found->odd[i] <= found->doubtful[i], WRONG_VALUE);
    if (!found->active[i])
        MUST(!found->codes[i], WRONG_VALUE);
    else if (!found->odd[i])
        MUST((uint32_t)found->codes[i] == word >> settings->reading.parity, WRONG_VALUE);
    else
        MUST((uint32_t)found->codes[i] < settings->codes, WRONG_VALUE);
}

/* Frames of any levels: plain words are those of the levels, readings those of the words, and an odd
 * frame changes nothing. */
static void read_frames(struct input *input)
{
    enum { FRAMES = 3, PIECES = 2 };
    size_t bits = 2 + input_u8(input) % 6, nodes = 1 + input_u16(input) % 300;
    size_t first = input_u8(input) % 4, order = first + nodes + input_u8(input) % 40;
    uint8_t options = input_u8(input), silent = input_u8(input);
    bool parity = options & 1, moved = options & 2, learnt = options & 4, scrambled = options & 16;
    size_t codes = (size_t)1 << (bits - parity), taxels = moved ? nodes + 3 : nodes;
    float swing = level_of(input_u8(input)), spread = (float)input_u8(input) * 1e-3f;
    float *rows = malloc(bits * order * sizeof *rows), *edges = malloc(4 * order * sizeof *edges);
    float *offset = malloc(bits * order * sizeof *offset);
    float *floats = calloc((17 + 3 * PIECES) * nodes + 2 * taxels + codes, sizeof *floats);
    int32_t *ints = calloc(3 * nodes + taxels, sizeof *ints);
    uint8_t *flags = calloc(10 * nodes + taxels, 1);
    double *heard_s = malloc(nodes * sizeof *heard_s);
    float *sign = floats + 16 * nodes, *pieces = sign + nodes, *of_taxels = pieces + 3 * PIECES * nodes;
    float *table = of_taxels + 2 * taxels;
    const struct readout_settings settings = {
        .frame = {bits, order, first, nodes, false, swing, 0.25f, 0.5f, 2.2},
        .reading = {.threshold = 0.5f,
                    .faint_share = 0.25f,
                    .least_squares = 0.1f,
                    .loud_squares = 32,
                    .hiding_rho = 12,
                    .tone_share = 0.1f,
                    .moved_share = 0.5f,
                    .sound_share = 0.8f,
                    .most_square = (float)bits + 0.04f,
                    .a_chip = order > 4 ? 1 : INFINITY,
                    .few_share = 0.5f,
                    .few = 3,
                    .parity = parity,
                    .limits = {5, 0.4f, 1.25f, 1.6f, 8, 0.5f}},
        .lateness = {0.35f, 0.3f, 4},
        .bits = {1, 4, 8, 2, 16, 32, 128},
        .scrambled = scrambled,
        .spare = first + nodes,
        .spare_count = order - first - nodes,
        .codes = codes,
        .pieces = PIECES,
        .taxels = taxels};
    const struct readout_skin skin = {ints,
                                      scrambled ? offset : NULL,
                                      floats,
                                      edges,
                                      table,
                                      flags,
                                      flags + nodes,
                                      flags + 2 * nodes,
                                      flags + 3 * nodes,
                                      sign,
                                      floats + nodes,
                                      floats + 15 * nodes,
                                      floats + 2 * nodes,
                                      pieces,
                                      moved ? ints + 3 * nodes : NULL,
                                      ints + nodes,
                                      flags + 4 * nodes,
                                      heard_s,
                                      floats + 3 * nodes};
    const struct readout_frame found = {flags + 5 * nodes,
                                        flags + 6 * nodes,
                                        flags + 7 * nodes,
                                        flags + 8 * nodes,
                                        ints + 2 * nodes,
                                        floats + 8 * nodes,
                                        floats + 9 * nodes,
                                        floats + 10 * nodes,
                                        of_taxels,
                                        of_taxels + taxels,
                                        flags + 10 * nodes,
                                        floats + 11 * nodes,
                                        floats + 12 * nodes,
                                        flags + 9 * nodes};
    float *drift_v = floats + 13 * nodes, *tare_pa = floats + 14 * nodes;

    for (size_t i = 0; i < codes; i++)
        table[i] = level_of(input_u8(input));
    for (size_t i = 0; i < 4 * order; i++)
        edges[i] = i % 5 ? 1 : -1;
    for (size_t i = 0; i < bits * order; i++)
        offset[i] = i % 3 ? 0.1f : -0.2f;
    for (size_t i = 0; i < nodes; i++) {
        uint8_t some = input_u8(input);
        floats[i] = swing;
        sign[i] = 1;
        ints[i] = (int32_t)(i % 2 ? 0 : (1u << bits) - 1);
        heard_s[i] = some & 128 ? -(double)INFINITY : 0;
        flags[i] = some & 64;
        for (size_t f = 1; f < 4; f++)
            flags[f * nodes + i] = some >> f & 1;
        floats[nodes + i] = (float)some * 0.01f;
        floats[15 * nodes + i] = (float)(some >> 3) * 0.01f;
        drift_v[i] = level_of(some);
        for (size_t f = 0; f < 3 * PIECES; f++)
            pieces[f * nodes + i] = (float)(some >> f & 7);
    }
    for (size_t i = 0; i < taxels; i++)
        ints[3 * nodes + i] = (int32_t)(i * 7 % (nodes + 1)) - 1;
    struct readout *readout = readout_new(&settings, &skin);
    for (double now_s = 1; now_s <= FRAMES; now_s++) {
        for (size_t i = 0; i < bits * order; i++) {
            uint8_t byte = input_u8(input);
            float level = byte & 64 ? level_of(byte) : 0.3f + (float)(byte & 31) * spread;
            rows[i] = i % order % 8 < silent % 9 ? (byte & 128 ? level : -level) : 0;
        }
        float words = *skin.sums;
        enum readout_look look = readout_read(readout, rows, NULL, 0, 100, learnt ? 0.01f : NAN, options & 8,
                                              now_s, 1.5, drift_v, tare_pa, &found);
        if (look <= READOUT_FEW) {
            MUST(*skin.sums == words, WRONG_VALUE);
            continue;
        }
        for (size_t i = 0; i < nodes; i++) {
            check_word(&settings, &skin, &found, rows, i);
            MUST(!found.active[i] || (skin.kept_codes[i] == found.codes[i] && heard_s[i] == now_s),
                 WRONG_VALUE);
            MUST(found.valid[i] <= !(skin.masked[i] | skin.invalid[i]), WRONG_VALUE);
        }
        for (size_t i = 0; i < taxels; i++) {
            int32_t node = moved ? ints[3 * nodes + i] : (int32_t)i;
            bool valid = node >= 0 && found.valid[node], masked = node < 0 || skin.masked[node];
            valid = valid && !(found.node_v[node] + drift_v[node] - skin.rest_v[node] >
                               skin.margin_v[node]);
            MUST(valid || (isnan(of_taxels[i]) && isnan(of_taxels[taxels + i])), WRONG_VALUE);
            MUST(masked ? found.status[i] == 32 : !(found.status[i] & 32), WRONG_VALUE);
        }
    }
    readout_free(readout);
    free(rows);
    free(edges);
    free(offset);
    free(floats);
    free(ints);
    free(flags);
    free(heard_s);
}

/* A frame of known words on a line without marks, and whatever the input adds to it: what is seen without
 * doubt on an undisturbed line was sent. */
static void look_for_frame(struct input *input)
{
    enum { MOST_BITS = 11 };
    unsigned twos = 2 + input_u8(input) % 4, kind = input_u8(input);
    size_t order = (size_t)1 << twos, bits = 4 + input_u8(input) % (MOST_BITS - 3), per_chip = 3 + kind % 3;
    size_t first = kind / 4 % 2, nodes = 1 + input_u8(input) % (order - first), chips = bits * order;
    struct transform *correlate = transform_new(twos, 0, NULL, NULL, 1.0f / (float)order, 0);
    struct transform *spread = transform_new(twos, 0, NULL, NULL, 1.0f, 0);
    size_t gap = 6 * order * per_chip / 10 + input_u8(input), frame = chips * per_chip;
    size_t after = (size_t)input_u8(input) * per_chip / 4, size = gap + frame + after;
    float *sent = calloc(chips, sizeof *sent), *levels = malloc(chips * sizeof *levels);
    double *volts = calloc(size, sizeof *volts);
    int32_t *places = malloc(chips * sizeof *places);
    double reaches[] = {0.5, 0.25};
    struct fit_code code = {{bits, order, first, nodes, false, NAN, 0.25f, 0.5f, 2.2},
                            chips, correlate, spread, NULL, places};
    const struct fit_refining refining = {0.3, 0.02, 2, reaches};
    const double chip = (double)per_chip, length = (double)frame;
    const struct gap_rules rules = {
        {0.3, 0.8, 1.28, 6}, 0.3, 0.02, length, 1.1 * length, 1.1 * (double)order * chip, 1.6 * length,
        2, 1.5, 3e-3, 6e-6, 0.02, 3, 60, -2.5, 2.5, 0.25, 1e-3, 0.5, 0.02, 0.12, 3, 0.15, 0.02, 0.25, 1.25, 0.3, 2.5,
        0.35, 1, 4, 2, 0.15, 512, first + nodes, order - first - nodes, false};
    size_t half = per_chip / 2, group = frame / half < 320 ? 1 : frame / half / 320, cell = half * group;
    const struct burst_search search = {
        half, 8, group, frame / cell, 11 * frame / 10 / cell + 1, order * per_chip / cell + 2,
        3 * (order * per_chip / cell + 2) * group, gap, order * per_chip / half, nodes, chip,
        0.1, 6, 1e-14, 1.2, 0.3, 1000, 4, 0.455, 0.2, 0.1};

    for (size_t bit = 0; bit < bits; bit++)
        for (size_t node = 0; node < nodes; node++)
            sent[bit * order + first + node] = input_u8(input) % 2 ? 1.0f : -1.0f;
    transform_multiply(spread, sent, levels, bits);
    for (size_t i = 0; i < chips; i++)
        places[i] = (int32_t)i;
    for (size_t i = 0; i < size; i++) {
        volts[i] = (i + kind) % 2 ? 0.005 : -0.005;
        if (i >= gap && i < gap + frame)
            volts[i] += (double)levels[(i - gap) / per_chip];
    }
    bool disturbed = input->left > 0;
    while (input->left) {
        size_t at = input_u16(input) % size, value = input_u8(input);
        volts[at] = value == 255 ? NAN : value == 254 ? 1e6 : (double)((int)value - 128) / 8;
    }
    struct gap_expected expected = {(double)gap - 0.5 + (kind & 16 ? 0.3 : 0), 0.05 * chip,
                                    kind & 32 ? 0 : chip, kind & 64 ? 1e-4 : 0.02};
    struct gap_seen seen;
    enum gap_look look;
    struct burst_gap known = {0, 1e-5, 0};
    float *words = malloc((chips + 2 * nodes + 4) * sizeof *words), *four = words + chips + 2 * nodes;
    double *values = malloc(gap_values(&search, size) * sizeof *values);
    float *scratch = malloc(gap_scratch(&code, &search) * sizeof *scratch);
    seen.words = (struct judge_words){words, words + chips, words + chips + nodes, four, four + 1, four + 2, four + 3};
    bool has_gap = gap_look(&code, &search, &rules, &refining, volts, volts, size, 0, &known, &expected, &seen, &look, values,
                            scratch);
    for (size_t i = 0; has_gap && look == GAP_FRAME && !disturbed && i < chips; i++)
        MUST(sent[i] == 0 || sent[i] * words[i] > 0, WRONG_VALUE);
    MUST(!has_gap || look != GAP_FRAME || seen.proven <= (double)size, WRONG_VALUE);

    free(sent);
    free(levels);
    free(volts);
    free(places);
    free(words);
    free(values);
    free(scratch);
    transform_free(correlate);
    transform_free(spread);
}

/* Contacts of frames of any pressures on a grid: every taxel is in one contact at most, and that is
 * connected to nothing above the release but itself; one that is uncertain is in none. */
static void touch(struct input *input)
{
    enum { NEAR = 4, MOST = 300 };
    size_t taxels = 1 + input_u16(input) % MOST, width = 1 + taxels % 17;
    int32_t near[MOST * NEAR], place[MOST], scratch[CONTACTS_SCRATCH * MOST], in[2 * MOST], starts[MOST + 1];
    int32_t tally[CONTACTS_TALLY];
    double moments[MOST * CONTACTS_MOMENTS] = {0}, loads[MOST], sums[MOST * CONTACTS_SUMS];
    uint8_t notes[MOST], flags[3 * MOST], status[MOST];
    float pressure_pa[MOST], peak_pa[MOST];
    const struct contacts_skin skin = {taxels, NEAR, near, moments, 0.5f, 0.2f, 0.06f, 8, 4, 2};
    const struct contacts_kept kept = {place, notes, scratch, loads};
    const struct contacts_found found = {in, in + MOST, starts, tally, sums, peak_pa, flags, flags + MOST, flags + 2 * MOST};

    for (size_t i = 0; i < taxels; i++) {
        int32_t own = (int32_t)i;
        near[NEAR * i] = i % width > 0 ? own - 1 : own;
        near[NEAR * i + 1] = i % width + 1 < width && i + 1 < taxels ? own + 1 : own;
        near[NEAR * i + 2] = i >= width ? own - (int32_t)width : own;
        near[NEAR * i + 3] = i + width < taxels ? own + (int32_t)width : own;
        moments[CONTACTS_MOMENTS * i] = 1;
        place[i] = -1;
        notes[i] = 1;
        status[i] = input_u8(input) % 16;
    }
    for (size_t frame = 0; frame < 6; frame++) {
        size_t in_contact = 0;
        for (size_t i = 0; i < taxels; i++)
            pressure_pa[i] = level_of(input_u8(input));
        size_t count = contacts_gather(&skin, pressure_pa, status, &kept, &found);
        MUST(count <= taxels && tally[0] <= tally[1] && tally[2] <= tally[0], WRONG_VALUE);
        for (size_t c = 0; c < count; c++) {
            MUST(starts[c] < starts[c + 1] && peak_pa[c] > skin.release_pa, WRONG_VALUE);
            for (int32_t at = starts[c]; at < starts[c + 1]; at++)
                MUST(place[in[at]] == (int32_t)c, WRONG_VALUE);
        }
        for (size_t i = 0; i < taxels; i++) {
            bool touched = pressure_pa[i] > skin.release_pa && !(status[i] & skin.uncertain);
            in_contact += place[i] >= 0;
            MUST(place[i] < 0 || touched, WRONG_VALUE);
            MUST(place[i] >= 0 || !touched || !(pressure_pa[i] > skin.contact_pa), WRONG_VALUE);
            for (size_t n = 0; touched && n < NEAR; n++) {
                int32_t beside = near[NEAR * i + n];
                bool presses = pressure_pa[beside] > skin.release_pa && !(status[beside] & skin.uncertain);
                MUST(!presses || place[beside] == place[i], WRONG_VALUE);
            }
        }
        MUST(!count || in_contact == (size_t)starts[count], WRONG_VALUE);
    }
}

/* The input's first byte selects the test. */
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    struct input input = {bytes, size};
    uint8_t test = input_u8(&input);

    switch (test < 224 ? test % 7 : 7) { /* inputs that are kept stay what they were */
    case 0:
        scan_bytes(&input);
        break;
    case 1:
        scan_packets(&input);
        break;
    case 2:
        transform(&input);
        break;
    case 3:
        fit_words(&input);
        break;
    case 4:
        read_frames(&input);
        break;
    case 5:
        add_samples(&input);
        break;
    case 6:
        look_for_frame(&input);
        break;
    case 7:
        touch(&input);
        break;
    }
    return 0;
}
