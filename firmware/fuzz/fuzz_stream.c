// SPDX-License-Identifier: Apache-2.0

/* The driver's compiled stream (kernel/frame_stream.h): packets as a digitizer sends them, more or
 * less, in pieces, with any answers to what it asks. A model of what was sent says which frames there
 * are, which samples they have, and when they must be decided. */
#include "reference.h"
#include "frame_stream.h"

#include <math.h>

enum { BITS = 2, ORDER = 4, CHIP = 2, SIZE = CHIP * BITS * ORDER, DUE = 20, EDGES = BITS * ORDER + 1 };
enum { MOST_PACKETS = 400, MOST_COUNT = 64, MOST_INDEX = MOST_PACKETS * MOST_COUNT * 2 };
enum { RATE_US = 1 }; /* a sample per microsecond */
#define BEHIND_US 10
#define UNKNOWN NAN
#define UNTIL (SIZE + 7.3)

/* What was sent: packets of samples by their sequence numbers. */
struct sent {
    uint64_t first_index, device_us;
    uint32_t count;
    bool sync, quiet, is_samples;
    int16_t counts[MOST_COUNT];
};

static struct sent sent[MOST_PACKETS];

/* How a run goes on; the same for any division of the bytes. */
struct run {
    uint64_t seed, hash;
    bool marked, in_blocks, has_timing, is_scrambled;
    /* The model. Indices are of the stream; -1: none. */
    int64_t end, open, waiting; /* waiting: the mark that ends the open frame */
    int64_t due;
    size_t due_of_frames;
    uint64_t origin, last_us;
    int held; /* the packet that is held back */
    bool is_placed;
    double volts[MOST_INDEX];
};

static struct run run;

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

static void forget_frame(void)
{
    run.open = run.waiting = -1;
}

/* ---- the model ---------------------------------------------------------------------------------- */

/* A packet was accepted. */
static void accept(const struct stream_passed *passed)
{
    const struct sent *packet = &sent[passed->sequence];
    int64_t index = (int64_t)(packet->first_index - run.origin);

    MUST(packet->is_samples && passed->count == packet->count, WRONG_VALUE);
    MUST(passed->index == index && passed->device_time_us == packet->device_us, WRONG_VALUE);
    MUST(run.waiting < 0, WRONG_VALUE); /* a frame is decided before the next one begins */
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
    if (run.open < 0) {
        run.open = index;
        run.due = index + (int64_t)run.due_of_frames;
    } else
        run.waiting = index;
}

/* The frame in progress is decided. */
static void decide(int64_t start, bool final)
{
    MUST(start >= 0 && start == run.open, WRONG_VALUE);
    MUST(run.waiting < 0 || final, WRONG_VALUE);
    run.open = run.waiting;
    run.due = run.open + (int64_t)run.due_of_frames;
    run.waiting = -1;
}

/* The index up to which samples may be waited for at most: the end of a frame has to be seen, too. */
static int64_t latest(void)
{
    int64_t seen = run.open + (int64_t)ceil(UNTIL);

    return run.has_timing && seen > run.due ? seen : run.due;
}

static void compare(int64_t start, const float *volts, size_t count)
{
    MUST(start >= 0 && start + (int64_t)count <= run.end, WRONG_VALUE);
    for (size_t i = 0; i < count && start + (int64_t)i < MOST_INDEX; i++) {
        double expected = run.volts[(size_t)start + i];
        MUST(isnan(expected) || (double)volts[i] == expected, WRONG_VALUE);
        add((uint64_t)(int64_t)((double)volts[i] * 1e3));
    }
}

/* No node may be taken for silence, nor silence for one. Scrambled chips spread a level that the line
 * has changed to over all rows, and these few may take it for words. */
static void check_power(const struct stream_subject *about, bool heard)
{
    double sum = 0, squares = 0;

    for (int i = 0; i < SIZE && about->start + i < MOST_INDEX; i++) {
        double volts = run.volts[about->start + i];
        sum += volts;
        squares += volts * volts;
    }
    double mean = sum / SIZE, power = squares / SIZE - mean * mean;
    double beside = run.is_scrambled ? mean - about->rest->level : 0;
    if (about->start + SIZE <= MOST_INDEX && !isnan(power))
        MUST(heard ? power + beside * beside > 620 : power <= 630, WRONG_VALUE);
}

/* ---- answers ----------------------------------------------------------------------------------- */

static int32_t whole[EDGES], places[BITS * ORDER];
static double share[EDGES], number[EDGES];

static void carry(struct stream *stream)
{
    struct stream_timing timing = {
        .due = run.marked && draw(4) == 0 ? DUE + draw(9) : DUE,
        .over = SIZE + 1,
        .uses = draw(8),
        .has_frame = run.has_timing,
        .frame = {.chip = CHIP,
                  .until = draw(3) ? DUE : UNTIL,
                  .heard = SIZE,
                  .tail = SIZE + 1,
                  .tail_end = DUE},
    };

    struct frame_edges edges = {{EDGES, whole, share, number}, places};
    run.due_of_frames = timing.due;
    MUST(stream_carry(stream, &timing, &edges), WRONG_VALUE);
}

static void place(struct stream *stream)
{
    const struct scanner_packet *found = &stream_subject(stream)->packet;
    const struct sent *packet = &sent[found->sequence];
    enum stream_answer answer = draw(4) ? STREAM_TAKE : draw(3);
    uint64_t origin = run.origin;
    bool cut_short, anew = true, was_open = run.open >= 0;

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
    MUST(stream_place(stream, answer, origin, anew, 3, packet->quiet ? 1 : 0, &cut_short), WRONG_VALUE);
    if (answer == STREAM_IGNORE)
        return;
    run.held = answer == STREAM_HOLD ? found->sequence : -1;
    if (answer == STREAM_HOLD)
        return;
    MUST(cut_short == (anew && was_open), UNCOUNTED_LOSS);
    run.origin = origin;
    run.is_placed = true;
    if (anew)
        forget_frame();
    run.end = (int64_t)(packet->first_index - origin);
}

static void answer_doubt(struct stream *stream)
{
    const struct stream_subject *about = stream_subject(stream);
    int64_t start = about->start, stop = start + (int64_t)about->count;
    bool needs_more = !about->final && draw(4) == 0;

    MUST(start == run.open, WRONG_VALUE);
    if (about->summed_up) {
        MUST(about->final && !about->count, WRONG_VALUE);
        stop = run.end;
    } else {
        MUST(about->final || (stop >= run.due && stop <= latest()), WRONG_VALUE);
        compare(start, about->volts, about->count);
    }
    add((uint64_t)about->look);
    add(about->marks);
    if (needs_more) {
        run.due = stop + 1 + draw(30);
        MUST(stream_decide(stream, run.due, -1, 0, 0), WRONG_VALUE);
    } else {
        bool is_known = draw(3);
        bool final = about->final;
        double level = about->rest->level;
        MUST(stream_decide(stream, -1, is_known ? stop : -1, level,
                           about->rest->noise), WRONG_VALUE);
        carry(stream);
        decide(start, final);
    }
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
    MUST(about->rest->noise >= 0 && !isnan(about->rest->level), WRONG_VALUE);
    if (event > STREAM_FULL)
        add(event);
    switch (event) {
    case STREAM_HEARD:
        MUST(run.has_timing, WRONG_VALUE);
        /* fall through */
    case STREAM_SILENT:
        check_power(about, event == STREAM_HEARD);
        add((uint64_t)about->start);
        decide(about->start, about->final);
        break;
    case STREAM_FOREIGN:
        place(stream);
        break;
    case STREAM_DOUBT:
        answer_doubt(stream);
        break;
    case STREAM_BLOCK:
        MUST(run.in_blocks, WRONG_VALUE);
        compare(about->start, about->volts, about->count);
        MUST(stream_look(stream, run.end + draw(200)), WRONG_VALUE);
        break;
    case STREAM_NEEDS_BYTES:
        MUST(run.open < 0 || run.end < latest(), UNCOUNTED_LOSS);
        MUST(run.waiting < 0, WRONG_VALUE);
        break;
    default:
        break;
    }
}

static uint64_t follow(const uint8_t *bytes, size_t size, size_t piece, uint64_t seed, uint8_t kind)
{
    static const float scale = 0.25f, flips[BITS * ORDER] = {1, -1, 1, 1, -1, 1, -1, -1};
    struct transform *transform = transform_new(2, 0, NULL, NULL, scale, 0);
    struct scanner *scanner = scanner_new(3);
    struct stream *stream = stream_new(scanner);
    float rows[BITS * ORDER];
    enum stream_event event;

    run = (struct run){.seed = seed, .hash = 0xCBF29CE484222325u, .held = -1};
    run.marked = kind % 8 < 6;
    run.in_blocks = kind % 8 == 6;
    run.has_timing = kind & 8;
    run.is_scrambled = kind & 32;
    forget_frame();
    struct frame_rules frame = {
        .frame = {.bits = BITS, .order = ORDER, .first = 1, .nodes = 3, .swing = 100,
                  .loudest_share = 0.25f, .active_share = 0.5f, .spoken_over = 2.2},
        .size = SIZE, .whole_size = SIZE, .chip = CHIP, .least_power = 625, .silent_power = 625, .most_noise = 80,
        .rail_low = -30000, .rail_high = 30000, .deafened = 0.25, .carried_noise = 1.5,
        .carried_misfit = 3e-3, .loud = 2, .tail_noise = 2, .tail_scatter = 8, .tail_level = 4,
        .least_tail = 0.5, .scrambled = run.is_scrambled, .silent_rise = 1, .silent_more = 2500};
    struct stream_rules rules = {
        .frame = frame, .marked = run.marked, .in_blocks = run.in_blocks,
        .volts_per_count = 1, .most_volts = 1e6, .gap_size = 8, .least_rest = 4, .gap_weight = 0.25,
        .rise = 4, .rise_v2 = 1e-6, .silent_over = SIZE + 1, .rate_hz = 1e6,
        .slack_s = BEHIND_US * 1e-6, .slack = 0.01,
        .most_device_us = 1u << 30, .most_quiet = MOST_COUNT, .most_quiet_v2 = 100};
    struct frame_code code = {.transform = transform, .flips = kind & 32 ? flips : NULL};
    MUST(stream_describe(stream, &rules, &code, rows), WRONG_VALUE);
    carry(stream);
    for (size_t begin = 0; begin < size; begin += piece) {
        size_t some = size - begin < piece ? size - begin : piece;
        stream_give(stream, bytes + begin, some, 1, false);
        do {
            event = stream_next(stream);
            take(stream, event);
            if (event == STREAM_PACKET && draw(3) == 0) {
                MUST(stream_describe(stream, &rules, &code, rows), WRONG_VALUE);
                forget_frame();
                carry(stream);
            }
        } while (event != STREAM_NEEDS_BYTES);
        MUST(!stream_left(stream), UNCOUNTED_LOSS);
    }
    stream_conclude(stream);
    do {
        event = stream_next(stream);
        take(stream, event);
    } while (event != STREAM_NEEDS_BYTES);
    MUST(run.open < 0, UNCOUNTED_LOSS); /* all that was marked is decided */
    stream_free(stream);
    scanner_free(scanner);
    transform_free(transform);
    return run.hash;
}

/* ---- what is sent ------------------------------------------------------------------------------- */

static int16_t level_of(const struct sent *packet, struct input *input, uint8_t shape, uint8_t kind,
                        uint32_t i)
{
    /* A word of the second row, silence, or anything. */
    bool is_frame = packet->sync && i < SIZE, bit = i < SIZE / 2 ? shape & 64 : shape & 128;
    int spoken = (bit ? 100 : -100) * (i / CHIP % 2 ? -1 : 1);

    if (kind & 8 && input->left)
        return (int16_t)((int8_t)input_u8(input) * (kind & 7));
    return (int16_t)(is_frame && kind & 16 ? 3 + spoken : 3 + (int)(i % 3));
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

    for (int edge = 0; edge < EDGES; edge++) {
        whole[edge] = CHIP * edge;
        number[edge] = CHIP;
        if (edge < BITS * ORDER)
            places[edge] = edge;
    }
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
                                .is_samples = shape != 255};
        for (uint32_t i = 0; i < packet->count; i++)
            packet->counts[i] = level_of(packet, &input, shape, kind, i);
        header.type = packet->quiet ? TP_QUIET : kind % 4 == 2 ? TP_PACKED : TP_SAMPLES;
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
    return 0;
}
