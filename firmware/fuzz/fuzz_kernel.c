// SPDX-License-Identifier: Apache-2.0

/* The driver's compiled kernel (kernel/): arbitrary bytes through its scanner and a reference reader,
 * whole numbers through its transforms and sums without any trick, any levels as words and readings, and
 * frames of known words, and whatever is added to them, through its reader. What follows a stream has a
 * harness of its own, fuzz_stream.c, and so have sparse codes, fuzz_sparse.c. */
#include "contacts.h"
#include "heard.h"
#include "readout.h"
#include "reference.h"
#include "scanner.h"
#include "scene.h"

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
    counts = *scanner_tell(scanner);
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
    uint8_t *bytes = own(size, 1);

    for (size_t i = 0; i < copies; i++)
        memcpy(bytes + i * input->left, input->bytes, input->left);
    if (copies > 1)
        bytes[size - 1] = 0;
    scan_in_pieces(bytes, size, piece);
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
    uint8_t *exact = own(size, 1);
    memcpy(exact, wire, size);
    scan_in_pieces(exact, size, piece);
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
        matrices[f] = own(orders[f] * orders[f], 1);
        for (size_t i = 0; i < orders[f] * orders[f]; i++)
            matrices[f][i] = input->left ? (int8_t)((int)(input_u8(input) % 2) * 2 - 1) : 1;
        order *= orders[f];
    }
    struct transform *made =
        transform_new(twos, count, orders, (const int8_t *const *)matrices, 1.0f, lanes);
    if (made && order <= MOST_ORDER) {
        size_t vectors = 1 + asked / 16 % 5, values = vectors * order;
        float *from = own(values, sizeof *from), *to = own(values, sizeof *to);
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
    }
    transform_free(made);
}

/* Words of any levels. */
static void fit_words(struct input *input)
{
    size_t bits = 1 + input_u8(input) % 17, nodes = 1 + input_u16(input) % 300;
    bool parity = bits > 1 && input_u8(input) & 128;
    input_u16(input);
    struct heard heard = heard_new(bits, nodes, parity, level_of(input_u8(input)));

    for (size_t i = 0; i < bits * nodes; i++)
        heard.rows[i] = level_of(input_u8(input));
    hear(&heard);
}

/* Samples of any level, and their means over chips of any timing: of samples, thus within them. */
static void add_samples(struct input *input)
{
    size_t size = 1 + input_u16(input) % 400, chips = 1 + input_u8(input), lead = input_u8(input);
    int16_t *counts = own(size, sizeof *counts);
    float *levels = own(chips, sizeof *levels), zero = (float)(int16_t)input_u16(input);
    float *volts = own(size, sizeof *volts);
    double *running = own(size + 1, sizeof *running), sum = 0;

    for (size_t i = 0; i < size; i++)
        counts[i] = (int16_t)input_u16(input);
    samples_volts(counts, size, zero, 0.5f, 20000, volts);
    for (size_t i = 0; i < size; i++) {
        float level = ((float)counts[i] - zero) * 0.5f;
        MUST(isnan(volts[i]) ? fabsf(level) >= 20000 : volts[i] == level, WRONG_VALUE);
        sum += (double)volts[i];
    }
    struct samples_sums sums = samples_add(volts, size);
    MUST(isnan(sum) ? isnan(sums.sum) : sums.sum == sum && !(sums.squares < 0), WRONG_VALUE);
    fit_sums(volts, size, 0.5, running);
    MUST(isnan(sum) ? isnan(running[size]) : running[size] == sum - 0.5 * (double)size, WRONG_VALUE);
    const struct fit_line line = {size, volts, running, 0.5};
    const struct fit fit = {(int16_t)input_u16(input) / 64.0, input_u16(input) / 4096.0};
    fit_levels(&line, &fit, 0.3, lead, chips, levels);
    for (size_t chip = 0; chip < chips; chip++)
        MUST(isnan(sum) || fabsf(levels[chip]) <= 20001, WRONG_VALUE);
}

enum { SIGN, REST, MARGIN, END, DRIFT, TARE, NODE_V, NODE_PA, FLOATS };
enum { STATE, INVALID, UNCALIBRATED, MASKED, KEPT, VALID, FLAGS };
enum { OUT_OF_USE = 32, PIECES = 2 };

/* What is kept of nodes that spoke now, and readings of taxels, from a node each, or none. */
static void check_readings(const struct readout_skin *skin, const struct readout_frame *found, size_t taxels,
                           const struct heard *heard, double now_s, const float *drift_v)
{
    for (size_t i = 0; i < heard->code.nodes; i++) {
        bool is_new = skin->kept_codes[i] == heard->words.codes[i] && skin->heard_s[i] == now_s;
        MUST(is_new || !heard->words.active[i], WRONG_VALUE);
        MUST(found->valid[i] <= !(skin->masked[i] | skin->invalid[i]), WRONG_VALUE);
    }
    for (size_t i = 0; i < taxels; i++) {
        int32_t node = skin->source ? skin->source[i] : (int32_t)i;
        bool masked = node < 0 || skin->masked[node], valid = node >= 0 && found->valid[node];
        float off_v = valid ? found->node_v[node] + drift_v[node] - skin->rest_v[node] : 0;
        valid = valid && !(off_v * skin->sign[node] > skin->margin_v[node]);
        MUST(valid || (isnan(found->pressure_pa[i]) && isnan(found->voltage_v[i])), WRONG_VALUE);
        MUST(masked ? found->status[i] == OUT_OF_USE : !(found->status[i] & OUT_OF_USE), WRONG_VALUE);
    }
}

/* A skin of so many nodes, of each of which a byte of the input says all. */
static void know(struct input *input, size_t nodes, float *const *floats, uint8_t *const *flags,
                 float *pieces, double *heard_s)
{
    for (size_t i = 0; i < nodes; i++) {
        uint8_t some = input_u8(input);
        heard_s[i] = some & 128 ? -(double)INFINITY : 0;
        flags[STATE][i] = some & 64;
        for (size_t f = INVALID; f <= MASKED; f++)
            flags[f][i] = some >> f & 1;
        floats[SIGN][i] = some & 32 ? -1 : 1;
        floats[REST][i] = (float)some * 0.01f;
        floats[MARGIN][i] = (float)(some >> 3) * 0.01f;
        floats[DRIFT][i] = level_of(some);
        for (size_t f = 0; f < 3 * PIECES; f++)
            pieces[f * nodes + i] = (float)(some >> f & 7);
    }
}

/* Levels of words, most of which are much alike; of nodes that speak: so many of 8. */
static void draw_rows(struct heard *heard, struct input *input, size_t speakers, float spread)
{
    const size_t nodes = heard->code.nodes;

    for (size_t i = 0; i < heard->code.bits * nodes; i++) {
        uint8_t byte = input_u8(input);
        float level = byte & 64 ? level_of(byte) : 0.3f + (float)(byte & 31) * spread;
        heard->rows[i] = i % nodes % 8 < speakers ? (byte & 128 ? level : -level) : 0;
    }
}

/* Words of any levels as readings: those are of the words, and what is kept is of the last ones. */
static void read_words(struct input *input)
{
    size_t bits = 2 + input_u8(input) % 6, nodes = 1 + input_u16(input) % 300;
    input_u16(input);
    uint8_t options = input_u8(input), speakers = input_u8(input) % 9, *flags[FLAGS];
    bool parity = options & 1, moved = options & 2, counts = options & 4;
    size_t codes = (size_t)1 << (bits - parity), taxels = moved ? nodes + 3 : nodes;
    struct heard heard = heard_new(bits, nodes, parity, level_of(input_u8(input)));
    float spread = (float)input_u8(input) * 1e-3f, *floats[FLOATS];
    float *pieces = own(3 * PIECES * nodes, sizeof *pieces), *table = own(codes, sizeof *table);
    float *sums = own(6 * nodes, sizeof *sums);
    int32_t *kept = own(nodes, sizeof *kept), *source = moved ? own(taxels, sizeof *source) : NULL;
    double *heard_s = own(nodes, sizeof *heard_s);

    for (size_t i = 0; i < FLOATS; i++)
        floats[i] = own(nodes, sizeof **floats);
    for (size_t i = 0; i < FLAGS; i++)
        flags[i] = own(nodes, 1);
    for (size_t i = 0; i < codes; i++)
        table[i] = level_of(input_u8(input));
    for (size_t i = 0; moved && i < taxels; i++)
        source[i] = (int32_t)(i * 7 % (nodes + 1)) - 1;
    know(input, nodes, floats, flags, pieces, heard_s);
    const struct readout_settings settings = {
        {1, 4, 8, 2, 16, OUT_OF_USE, 128}, nodes, codes, PIECES, taxels, 8, 0.4f, options & 8 ? NAN : 0.1f,
        12};
    const struct readout_skin skin = {
        table, flags[STATE], flags[INVALID], flags[UNCALIBRATED], flags[MASKED], floats[SIGN], floats[REST],
        floats[MARGIN], floats[END], pieces, source, kept, flags[KEPT], heard_s, sums};
    const struct readout_frame found = {own(taxels, 4), own(taxels, 4), own(taxels, 1), floats[NODE_V],
                                        floats[NODE_PA], flags[VALID]};
    struct readout *readout = readout_new(&settings, &skin);
    for (double now_s = 1; now_s <= 3; now_s++) {
        draw_rows(&heard, input, speakers, spread);
        hear(&heard);
        float before = *sums;
        readout_read(readout, &heard.words, counts, now_s, 1.5, floats[DRIFT], floats[TARE], &found);
        MUST(counts ? *sums >= before + heard.words.active[0] : *sums == before, WRONG_VALUE);
        check_readings(&skin, &found, taxels, &heard, now_s, floats[DRIFT]);
    }
    readout_free(readout);
}

/* A frame of known words, and what the input adds to it, some times; timing and noise are carried over. */
static void read_frame(struct input *input)
{
    uint8_t options = input_u8(input), kind = input_u8(input);
    struct scene *scene = make_scene(input, options, kind);
    const struct code *code = &scene->book.code;
    const struct frame_rules rules =
        frames_rules(code, scene->nominal, scene->has_raster ? 4 : 2, 2.0 * (double)code->order);
    struct frame_rest rest = {0};
    float *expected = own(code->nodes, sizeof *expected);
    const struct words words = words_in(own(code->nodes, WORDS_BYTES), code->nodes);
    const bool is_plain = !scene->absurd && !isnan(code->swing) && scene->timing != PROPOSED;
    struct frame_found found;
    double powers[3];

    if (scene->has_raster || !(kind & 8))
        rest = (struct frame_rest){0.25, 7e-5 / scene->chip, true};
    for (size_t node = 0; node < code->nodes; node++)
        expected[node] = 1;
    struct frame_reader *reader =
        frame_reader_new(code, &rules, &FRAMES_LIMITS, expected, own(code->nodes, 1));
    for (size_t again = 0; again < (rules.integrated ? 10 : 2); again++) {
        if (scene->has_raster)
            frame_reader_expect(reader, &scene->known, scene->timing == RASTER ? 0.5 : HUGE_VAL, again);
        enum frame_verdict verdict = read_from(reader, scene, &rest, &words, &found);
        MUST(verdict <= FRAME_READ || !is_plain, WRONG_VALUE);
        if (verdict == FRAME_READ)
            check_read(scene, &words, &found);
        else if (verdict == FRAME_SILENT)
            check_silence(scene, &rules, &found);
    }
    struct fitter *fitter = frame_reader_fitter(reader);
    MUST(fitter_line(fitter, scene->volts, scene->size, rest.level), WRONG_VALUE);
    fitter_explained(fitter, scene->known, 3, powers);
    MUST(scene->absurd || powers[0] >= -1e-6, WRONG_VALUE);
    double chip = fitter_duration(fitter, rest.noise_v2, scene->known.start, 0.25);
    MUST(chip == 0 || (chip >= rules.fit.least_chip && chip <= rules.fit.most_chip), WRONG_VALUE);
    fitter_gains(fitter, -0.5, 1, &scene->known.chip, 1, powers);
    MUST(scene->absurd || powers[0] >= 0, WRONG_VALUE);
    frame_reader_free(reader);
    frames_free(&scene->book);
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
    const struct contacts_found found = {in,      in + MOST, starts,       tally,           sums,
                                         peak_pa, flags,     flags + MOST, flags + 2 * MOST};

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

/* The input's first byte selects the test; inputs that are kept stay what they were. */
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    static void (*const tests[])(struct input *) = {scan_bytes, scan_packets, transform, fit_words,
                                                    read_words, add_samples,  read_frame, touch};
    struct input input = {bytes, size};
    uint8_t test = input_u8(&input);

    tests[test < 224 ? test % 7 : 7](&input);
    free_all();
    return 0;
}
