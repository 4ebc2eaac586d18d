// SPDX-License-Identifier: Apache-2.0

/* The driver's compiled stream (kernel/frame_stream.h): packets as a digitizer sends them, more or
 * less, in pieces, with any answers to what it asks. A model of what was sent says which frames there
 * are, which samples they have, when they must be decided, and what was said in them. */
#include "frame_stream.h"
#include "frames.h"
#include "reference.h"

enum { BITS = 2, TWOS = 2, CHIPS = BITS << TWOS, NODES = 3 };
enum { MOST_PACKETS = 400, MOST_COUNT = 64, MOST_INDEX = MOST_PACKETS * MOST_COUNT * 2 };
enum { RATE_US = 1 }; /* a sample per microsecond */
enum { SILENCE = -1, ANYTHING = -2 };
#define BEHIND_US 10
#define UNKNOWN NAN
#define SWING 100

/* What was sent: packets of samples by their sequence numbers. word: of node 0 in the frame that begins. */
struct sent {
    uint64_t first_index, device_us;
    uint32_t count;
    bool sync, quiet, is_samples;
    int word;
    int16_t counts[MOST_COUNT];
};

static struct sent sent[MOST_PACKETS];
static bool is_clean; /* nothing but words and the line at rest was sent */
static struct frames_book book;

/* How a run goes on; the same for any division of the bytes. */
struct run {
    uint64_t seed, hash;
    bool marked, in_blocks;
    struct frame_rules frame;
    struct frame_reader *reader;
    /* The model. Indices are of the stream. */
    int64_t end, begins[MOST_PACKETS];         /* of the frames that were marked */
    uint16_t marks[MOST_PACKETS];              /* the packets that marked them */
    size_t marked_count, told_count;           /* of these, and of those that were told of */
    uint64_t origin, last_us;
    int held; /* the packet that is held back */
    bool is_placed;
    double volts[MOST_INDEX];
};

static struct run run;
static _Alignas(float) uint8_t lent[WORDS_BYTES * NODES];

static void add(uint64_t value)
{
    run.hash = (run.hash ^ value) * 0x100000001B3u;
}

/* The next of the numbers by which questions are answered. */
static unsigned draw(unsigned below)
{
    run.seed = run.seed * 6364136223846793005u + 1442695040888963407u;
    return (unsigned)(run.seed >> 33) % below;
}

/* ---- the model ---------------------------------------------------------------------------------- */

/* A packet was accepted. */
static void accept(const struct stream_passed *passed)
{
    const struct sent *packet = &sent[passed->sequence];
    int64_t index = (int64_t)(packet->first_index - run.origin);

    MUST(packet->is_samples && passed->count == packet->count, WRONG_VALUE);
    MUST(passed->index == index && passed->device_time_us == packet->device_us, WRONG_VALUE);
    if (!run.is_placed) { /* it was not asked about */
        int64_t ahead_us = (int64_t)(packet->device_us - run.last_us);
        MUST(index == run.end, UNCOUNTED_LOSS);
        MUST(llabs(ahead_us) <= BEHIND_US + MOST_COUNT / 50, WRONG_VALUE);
        MUST(run.held < 0, WRONG_VALUE);
    }
    run.is_placed = false;
    run.last_us = packet->device_us + packet->count * RATE_US;
    for (uint32_t i = 0; i < packet->count && index + i < MOST_INDEX; i++)
        run.volts[index + i] = packet->quiet ? UNKNOWN : packet->counts[i];
    run.end = index + packet->count;
    if (!run.marked || !packet->sync)
        return;
    run.begins[run.marked_count] = index;
    run.marks[run.marked_count++] = passed->sequence;
}

/* Frames that were decided: told of, or rejected. */
static size_t decided(const struct stream_subject *about)
{
    size_t count = run.told_count;

    for (size_t verdict = 0; verdict < FRAME_VERDICTS; verdict++)
        count += about->rejected[verdict];
    return count;
}

/* Samples from a frame's begin that may be waited for at most: the end of a frame has to be seen, too. */
static int64_t latest(void)
{
    const struct frame_rules *frame = &run.frame;

    if (frame->integrated)
        return (int64_t)frame->size;
    return (int64_t)ceil(frame->fit.latest + frame->fit.most_chip * (CHIPS + frame->tail));
}

static void compare(const struct stream_subject *about)
{
    MUST(about->start >= 0 && about->start + (int64_t)about->count <= run.end, WRONG_VALUE);
    for (size_t i = 0; i < about->count && about->start + (int64_t)i < MOST_INDEX; i++) {
        double expected = run.volts[(size_t)about->start + i];
        MUST(isnan(expected) || (double)about->volts[i] == expected, WRONG_VALUE);
        add((uint64_t)(int64_t)((double)about->volts[i] * 1e3));
    }
}

/* No node may be taken for silence, nor silence for one. */
static void check_power(const struct stream_subject *about)
{
    double sum = 0, squares = 0, size = (double)run.frame.size;

    for (size_t i = 0; i < run.frame.size; i++) {
        double volts = about->volts[i];
        sum += volts;
        squares += volts * volts;
    }
    double power = squares / size - sum / size * (sum / size), silent = run.frame.silent_power;
    MUST(about->has_words || power <= silent * 1.0001, WRONG_VALUE);
    MUST(!about->has_words || run.frame.integrated || power >= silent * 0.9999, WRONG_VALUE);
}

/* What is in no doubt on an undisturbed line was sent. */
static void check_words(const struct stream_subject *about, int word)
{
    const struct words words = words_in(lent, NODES);

    for (int node = 0; node < NODES; node++) {
        bool is_heard = about->has_words && words.active[node], speaks = node == 0 && word != SILENCE;
        if (about->has_words) {
            add((uint64_t)words.codes[node] << 2 | words.doubtful[node] << 1 | words.active[node]);
            MUST(words.active[node] <= 1 && words.doubtful[node] <= 1, WRONG_VALUE);
        }
        if (!is_clean || word == ANYTHING || (about->has_words && words.doubtful[node]))
            continue;
        MUST(is_heard == speaks && (!speaks || words.codes[node] == word), WRONG_VALUE);
    }
}

/* Frame `number` of those that were marked was told of. */
static void check_frame(const struct stream_subject *about, size_t number)
{
    const struct sent *packet = &sent[run.marks[number]];

    MUST(about->start == run.begins[number], WRONG_VALUE);
    MUST(about->rest->noise_v2 >= 0 && !isnan(about->rest->level), WRONG_VALUE);
    if (packet->quiet && packet->count >= run.frame.size)
        MUST((run.frame.integrated || !about->has_words) && about->found.chip_noise_v <= run.frame.most_noise, WRONG_VALUE);
    else {
        MUST(about->count >= run.frame.size, WRONG_VALUE);
        compare(about);
        check_power(about);
    }
    check_words(about, packet->count < run.frame.size ? ANYTHING : packet->word);
    add((uint64_t)about->start);
    add((uint64_t)(int64_t)(about->found.chip * 1e6));
}

/* ---- answers ----------------------------------------------------------------------------------- */

static void describe(struct stream *stream)
{
    struct stream_rules rules = {
        .marked = run.marked, .in_blocks = run.in_blocks, .volts_per_count = 1, .most_volts = 1e6,
        .gap_size = 8, .sure_gap = 4, .least_rest = 4, .gap_weight = 0.25, .rise = 4, .rise_v2 = 1e-6,
        .most_waits = 4, .rate_hz = 1e6, .slack_s = BEHIND_US * 1e-6, .slack = 0.01,
        .most_device_us = 1u << 30, .most_quiet = MOST_COUNT, .most_quiet_v2 = 100};

    MUST(stream_describe(stream, &rules, run.marked ? run.reader : NULL, lent), WRONG_VALUE);
    run.marked_count = run.told_count = 0;
}

static void place(struct stream *stream)
{
    const struct stream_subject *about = stream_subject(stream);
    const struct scanner_packet *found = &about->packet;
    const struct sent *packet = &sent[found->sequence];
    enum stream_answer answer = draw(4) ? STREAM_TAKE : draw(3);
    uint64_t origin = run.origin;
    size_t before = decided(about);
    bool anew = true;

    if (run.held >= 0 && draw(2)) {
        answer = STREAM_TAKE_HELD;
        packet = &sent[run.held];
    }
    MUST(packet->is_samples, WRONG_VALUE);
    int64_t index = (int64_t)(packet->first_index - origin);
    if (index < run.end || index > run.end + 100 || draw(8) == 0) {
        origin = packet->first_index;
        for (size_t i = 0; i < MOST_INDEX; i++)
            run.volts[i] = UNKNOWN;
    } else
        anew = index != run.end;
    if (answer == STREAM_TAKE && run.held >= 0)
        run.held = -1;
    MUST(stream_place(stream, answer, origin, anew, 3, packet->quiet ? 1 : 0), WRONG_VALUE);
    if (answer == STREAM_IGNORE)
        return;
    run.held = answer == STREAM_HOLD ? found->sequence : -1;
    if (answer == STREAM_HOLD)
        return;
    MUST(decided(about) == (anew ? run.marked_count : before), UNCOUNTED_LOSS);
    run.origin = origin;
    run.is_placed = true;
    run.end = (int64_t)(packet->first_index - origin);
}

/* ---- a run ------------------------------------------------------------------------------------- */

static void take(struct stream *stream, enum stream_event event)
{
    const struct stream_subject *about = stream_subject(stream);
    const struct stream_passed *passed;
    size_t count = stream_passed(stream, &passed);

    MUST(count <= STREAM_MOST_PASSED, WRONG_VALUE);
    for (size_t i = 0; i < count; i++)
        accept(&passed[i]);
    run.told_count += event == STREAM_FRAME;
    size_t done = decided(about), open = run.marked_count - done;
    /* A frame is decided before the next one begins. */
    MUST(open <= 1 + (event == STREAM_SEARCH), WRONG_VALUE);
    if (event > STREAM_FULL)
        add(event);
    switch (event) {
    case STREAM_FRAME:
        check_frame(about, done - 1);
        break;
    case STREAM_SEARCH:
        MUST(open && about->start == run.begins[done], WRONG_VALUE);
        compare(about);
        MUST(stream_propose(stream, -0.5, draw(3) * run.frame.fit.chip * (0.95 + 0.01 * draw(20))), WRONG_VALUE);
        break;
    case STREAM_FOREIGN:
        place(stream);
        break;
    case STREAM_BLOCK:
        MUST(run.in_blocks, WRONG_VALUE);
        compare(about);
        MUST(stream_gather(stream, run.end + draw(200)), WRONG_VALUE);
        break;
    case STREAM_NEEDS_BYTES:
        MUST(!open || run.end < run.begins[done] + latest(), UNCOUNTED_LOSS);
        break;
    default:
        break;
    }
}

static void go_on(struct stream *stream)
{
    enum stream_event event;

    do {
        event = stream_next(stream);
        take(stream, event);
        if (event == STREAM_PACKET && draw(3) == 0)
            describe(stream);
    } while (event != STREAM_NEEDS_BYTES);
    MUST(stream_give(stream, NULL, 0, 1, false), UNCOUNTED_LOSS);
}

static uint64_t follow(const uint8_t *bytes, size_t size, size_t piece, uint64_t seed, uint8_t kind)
{
    static float expected[NODES];
    static const uint8_t broken[NODES];
    struct scanner *scanner = scanner_new(3);
    struct stream *stream = stream_new(scanner);

    for (size_t node = 0; node < NODES; node++)
        expected[node] = SWING;
    run = (struct run){.seed = seed, .hash = 0xCBF29CE484222325u, .held = -1};
    run.marked = kind % 8 < 6;
    run.in_blocks = kind % 8 == 6;
    run.frame = frames_rules(&book.code, kind & 128 ? 1 : 2, 2, 30000);
    run.frame.searches &= kind >> 3 & 1;
    run.reader = frame_reader_new(&book.code, &run.frame, &FRAMES_LIMITS, expected, broken);
    describe(stream);
    for (size_t begin = 0; begin < size; begin += piece) {
        size_t some = size - begin < piece ? size - begin : piece;
        stream_give(stream, bytes + begin, some, 1, false);
        go_on(stream);
    }
    stream_conclude(stream);
    go_on(stream);
    MUST(decided(stream_subject(stream)) == run.marked_count, UNCOUNTED_LOSS); /* all that was marked */
    stream_free(stream);
    scanner_free(scanner);
    frame_reader_free(run.reader);
    return run.hash;
}

/* ---- what is sent ------------------------------------------------------------------------------- */

/* The codes of a run's kind: bit 4 unipolar, 5 scrambled, 6 of unknown amplitude, 7 one sample per chip. */
static void make_book(uint8_t kind)
{
    book = (struct frames_book){.code = {.bits = BITS, .first = 1, .nodes = NODES, .unipolar = kind & 16,
                                         .scrambled = kind & 32, .swing = kind & 64 ? NAN : SWING}};
    frames_make(&book, TWOS, 0);
}

/* Sample i of a packet: a word of the second row, silence, or anything. */
static int16_t level_of(struct sent *packet, struct input *input, uint8_t run_kind, uint8_t kind, uint32_t i)
{
    uint32_t chip = run_kind & 128 ? i : i / 2;

    if (kind & 8 && input->left) {
        is_clean = false;
        return (int16_t)((int8_t)input_u8(input) * (kind & 7));
    }
    if (!packet->sync || chip >= CHIPS || !(kind & 16))
        return (int16_t)(3 + (int)(i % 3));
    bool is_one = packet->word >> (BITS - 1 - chip / (CHIPS / BITS)) & 1;
    int spoken = is_one == chip % 2 ? -SWING : SWING, pedestal = book.code.unipolar ? SWING : 0;
    return (int16_t)(3 + pedestal + (book.code.scrambled ? (int)book.flips[chip] * spoken : spoken));
}

static size_t write_quiet(struct sent *packet, struct input *input, uint8_t *body)
{
    int64_t mean = (int8_t)input_u8(input);
    struct tp_quiet quiet = {
        .device_time_us = packet->device_us,
        .first_index = packet->first_index,
        .flags = packet->sync,
        .count = packet->count,
        .sum = mean * packet->count,
        .sum_of_squares = (uint64_t)(mean * mean) * packet->count + input_u8(input),
    };

    memcpy(body, &quiet, sizeof quiet);
    return sizeof quiet;
}

static size_t write_samples(struct sent *packet, bool packs, uint8_t *body)
{
    struct tp_packed head = {.device_time_us = packet->device_us,
                             .first_index = packet->first_index,
                             .flags = packet->sync,
                             .base = -2048,
                             .step = 1};
    size_t head_size = packs ? sizeof head : sizeof(struct tp_samples);
    uint8_t *values = body + head_size;

    memcpy(body, &head, head_size); /* both begin alike */
    for (size_t i = 0; i < packet->count; i++) {
        uint16_t word = (uint16_t)packet->counts[i] ^ TP_SAMPLE_XOR;
        unsigned value = (unsigned)(packet->counts[i] + 2048) ^ 0x555u;
        if (!packs)
            memcpy(values + 2 * i, &word, sizeof word);
        for (size_t half = 3 * i; packs && half < 3 * i + 3; half++, value >>= 4)
            values[half / 2] = (uint8_t)(half % 2 ? values[half / 2] | (value & 15u) << 4 : value & 15u);
    }
    return head_size + (packs ? (3 * packet->count + 1) / 2 : 2 * packet->count);
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    static uint8_t wire[1 << 16], body[512];
    struct input input = {bytes, size};
    uint8_t run_kind = input_u8(&input);
    size_t piece = 1 + input_u8(&input), wire_size = 0;
    uint64_t index = 7, seed = input_u8(&input), us = 7;
    uint16_t sequence = 0;

    make_book(run_kind);
    is_clean = true;
    while (input.left && sequence < MOST_PACKETS && wire_size + 400 < sizeof wire) {
        struct sent *packet = &sent[sequence];
        uint8_t kind = input_u8(&input), shape = input_u8(&input);
        uint64_t off = kind & 128 ? (uint64_t)(int8_t)input_u8(&input) : 0;
        struct tp_header header = {.sequence = sequence};
        *packet = (struct sent){.first_index = index + (kind & 64 ? 0 : off),
                                .device_us = us + (kind & 64 ? off : 0),
                                .count = 1 + shape % 40u,
                                .sync = kind & 32,
                                .quiet = kind % 4 == 3,
                                .is_samples = shape != 255,
                                .word = kind & 16 ? (shape >> 6 & 1) << 1 | shape >> 7 : SILENCE};
        for (uint32_t i = 0; i < packet->count; i++)
            packet->counts[i] = level_of(packet, &input, run_kind, kind, i);
        header.type = packet->quiet ? TP_QUIET : kind % 4 == 2 ? TP_PACKED : TP_SAMPLES;
        is_clean &= !packet->quiet;
        size_t body_size = sizeof header;
        if (!packet->is_samples)
            header.type = TP_STATUS;
        else if (packet->quiet)
            body_size += write_quiet(packet, &input, body + sizeof header);
        else
            body_size += write_samples(packet, header.type == TP_PACKED, body + sizeof header);
        memcpy(body, &header, sizeof header);
        if (packet->is_samples) {
            index = packet->first_index + packet->count;
            us += packet->count * RATE_US;
        }
        sequence++;
        wire_size += framing_wrap(body, body_size, wire + wire_size);
    }
    uint8_t *exact = malloc(wire_size + !wire_size);
    memcpy(exact, wire, wire_size);
    uint64_t at_once = follow(exact, wire_size, wire_size + !wire_size, seed, run_kind);
    MUST(follow(exact, wire_size, piece, seed, run_kind) == at_once, WRONG_VALUE);
    free(exact);
    frames_free(&book);
    return 0;
}
