// SPDX-License-Identifier: Apache-2.0

/* A sensing node whose memory, sync pulses and readings come from the input: checks which of them it
 * accepts, what it transmits, and in which frames. */
#include <stdlib.h>
#include <string.h>

#include "discipline.h"
#include "event.h"
#include "frame.h"
#include "reference.h"
#include "node_memory.h"
#include "sequencer.h"
#include "sync_pulse.h"
#include "turn.h"

#define MEMORY 1024 /* bytes of an ATmega328P's EEPROM; an ATtiny85 has fewer */
#define ROW_OCTETS 121
#define TICKS_PER_US 8
#define UNIT_TICKS (TP_SYNC_UNIT_US * TICKS_PER_US)

static const struct node_limits slow = {
    .order = 8 * ROW_OCTETS,
    .chip_ns = 30000,
    .scrambled_chip_ns = 36000,
    .sparse_chip_ns = 40000,
    .longest_chip_ns = 90000,
    .chip_step_ns = 1,
    .bits_restart = false,
    .measuring_us = 900,
    .restart_us = 96,
    .hears_own = true,
    .hears_data = true,
};
static const struct node_limits fast = {
    .order = 8 * ROW_OCTETS,
    .chip_ns = 500,
    .scrambled_chip_ns = 1750,
    .sparse_chip_ns = 2000,
    .longest_chip_ns = 16000,
    .chip_step_ns = 250,
    .bits_restart = true,
    .measuring_us = 900,
    .restart_us = 80,
    .hears_own = true,
};
static const struct node_limits *limits;
static uint8_t memory[MEMORY];

static uint8_t read_memory(uint16_t address)
{
    MUST(address < MEMORY, WRONG_VALUE);
    return memory[address];
}

/* The record of a node, mostly a valid one. */
static struct tp_node_record record_of(struct input *input)
{
    uint8_t flags = input_u8(input);
    struct tp_node_record record = {
        .magic = TP_NODE_MAGIC,
        .version = TP_NODE_VERSION + (flags >> 7), /* of bit 7 one version, and what it changes in one place */
        .nodes = 1 + input_u8(input) % 12,
        .sign = flags & 1 ? 1 : -1,
        .bits = 8 + input_u8(input) % 3,
        .parity = flags >> 1 & 1,
        .order = (uint16_t)(1 + input_u16(input) % (flags & 0x40 ? 8 * ROW_OCTETS + 100 : 40)),
        .chip_ns = 30000 + input_u16(input),
        .discipline = flags >> 2 & 1,
        .threshold = input_u8(input),
        .heartbeat = input_u8(input),
    };

    if (limits == &fast) {
        record.chip_ns = 250u * (1 + input_u8(input) % 65) + (input_u8(input) % 32 == 0);
        record.resync_chips = (uint16_t)(record.order - (input_u8(input) % 32 == 0));
        record.guard_chips = (uint8_t)(80000 / record.chip_ns + input_u8(input) % 3);
    }
    record.node = (uint16_t)(1 + input_u8(input) % record.nodes);
    record.turn = (uint16_t)(record.heartbeat ? input_u8(input) % record.heartbeat : 0);
    if (flags & 0x20)
        record.digits = 4 + input_u8(input) % 13;
    if (flags & 8) {
        record.resync_chips = 1 + input_u16(input) % 500;
        record.guard_chips = 4 + input_u8(input) % 8;
    }
    if (flags & 0x10)
        record.scramble = input_u32(input);
    uint32_t chips = (record.bits + record.parity) * (uint32_t)record.order;
    uint64_t span = frame_span(chips, record.resync_chips, record.guard_chips);
    record.frame_period_us = (uint32_t)(span * record.chip_ns / 1000) + 965 + input_u16(input);
    if (flags & 0x80) /* and anything in one place */
        ((uint8_t *)&record)[input_u8(input) % sizeof record] = input_u8(input);
    return record;
}

/* Octets that follow the record. */
static size_t octets_of(const struct tp_node_record *record)
{
    return record->digits ? record->digits : (record->order + 7u) / 8;
}

/* Any bytes, or a record and a row that fit their CRC; for one of two boards. */
static void write_memory(struct input *input)
{
    const uint8_t *bytes;

    uint8_t kind = input_u8(input);

    memset(memory, 0xFF, sizeof memory);
    limits = kind & 0x80 ? &fast : &slow;
    if (kind % 8 == 0) {
        size_t size = input_bytes(input, &bytes, MEMORY);
        memcpy(memory, bytes, size);
        return;
    }
    struct tp_node_record record = record_of(input);
    size_t octets = octets_of(&record), size = sizeof record + octets;
    size = size < MEMORY - sizeof(uint32_t) ? size : MEMORY - sizeof(uint32_t);
    memcpy(memory, &record, sizeof record);
    octets = input_bytes(input, &bytes, octets < 16 ? octets : 16);
    memcpy(memory + sizeof record, bytes, octets);
    uint32_t crc = framing_crc(memory, size);
    memcpy(memory + size, &crc, sizeof crc);
}

/* Whether the board can do what a record asks for. */
static bool is_within_limits(const struct tp_node_record *record)
{
    uint64_t chips = (uint64_t)(record->bits + record->parity) * record->order;
    uint64_t slots = record->resync_chips ? (chips - 1) / record->resync_chips : 0;
    uint64_t guard_ns = (uint64_t)record->guard_chips * record->chip_ns;
    uint64_t used_ns = chips * record->chip_ns + slots * guard_ns;

    uint32_t least_ns = record->scramble ? limits->scrambled_chip_ns : limits->chip_ns;

    MUST(record->version == TP_NODE_VERSION || (record->version == TP_NODE_VERSION_DATA && limits == &slow),
         WRONG_VALUE);
    if (record->digits)
        least_ns = limits->sparse_chip_ns;
    else if (record->order > limits->order)
        return false;
    if (record->chip_ns > limits->longest_chip_ns || record->chip_ns < least_ns ||
        (limits == &slow && record->digits && record->resync_chips))
        return false;
    if (limits == &fast && (record->chip_ns % 250 || record->order % 2 ||
                            record->resync_chips != record->order))
        return false;
    return (slots == 0 || guard_ns >= 1000ull * limits->restart_us) &&
           used_ns + 964000 <= record->frame_period_us * 1000ull;
}

/* Conditions that an intact memory meets, accepted or not. */
static void check_record(const struct tp_node_record *record, bool accepted)
{
    size_t size = sizeof *record + octets_of(record);
    uint32_t crc;

    memcpy(&crc, memory + size, sizeof crc);
    MUST(crc == framing_crc(memory, size), WRONG_VALUE);
    MUST(record->order >= 1 && (!record->digits || (record->digits >= 4 && record->digits <= 16)), WRONG_VALUE);
    MUST(record->bits >= 8 && record->bits <= 10 && record->node <= record->nodes, WRONG_VALUE);
    MUST(accepted == is_within_limits(record), WRONG_VALUE);
}

#define MOST_OCTETS (11u * 4096 / 8) /* of a frame */

/* The octets of a sparse code, from docs/protocol.md: octet q + m is that of q and those of q + a, XORed. */
static void step_octets(uint8_t *octets, uint32_t width, uint32_t count)
{
    static const char *const exponents[] = {
        "1", "2", "1", "1", "234", "4", "3", "2", "146", "134", "135", "1", "235",
    };

    for (uint32_t q = width; q < count; q++) {
        octets[q] = octets[q - width];
        for (const char *a = exponents[width - 4]; *a; a++)
            octets[q] ^= octets[q - width + (uint32_t)(*a - '0')];
    }
}

/* Compares every chip of a word with the definition of a frame. */
static void check_chips(const struct tp_node_record *record, const uint8_t *row, uint16_t code)
{
    struct sequencer sequencer;
    uint32_t bits = record->bits + record->parity;
    uint16_t word = code & (uint16_t)((1u << record->bits) - 1);
    uint32_t octets = (record->order + 7u) / 8, flipped_at = UINT32_MAX, state = record->scramble;
    static uint8_t stepped[MOST_OCTETS + 16];

    if (record->parity)
        word = (uint16_t)(word << 1 | __builtin_parity(word));
    if (record->digits) {
        memcpy(stepped, row, record->digits);
        step_octets(stepped, record->digits, bits * octets);
    }
    sequencer_init(&sequencer, record, row);
    sequencer_start(&sequencer, code);
    for (uint32_t chip = 0, all = bits * record->order; chip < all; chip++) {
        uint32_t place = 8 * octets - record->order + chip % record->order;
        uint32_t octet = chip / record->order * octets + place / 8;
        if (octet != flipped_at) /* the next one */
            state = scrambled(state);
        flipped_at = octet;
        bool one = word >> (bits - 1 - chip / record->order) & 1;
        uint8_t chips = record->digits ? (uint8_t)~stepped[octet] : row[place / 8];
        bool plus = chips >> place % 8 & 1;
        bool high = ((one == plus) == (record->sign > 0)) != (state >> 24 >> place % 8 & 1);
        bool guard = record->resync_chips && (chip + 1) % record->resync_chips == 0;
        enum sequencer_next next = chip + 1 == all ? SEQUENCER_END
                                   : guard         ? SEQUENCER_GUARD
                                                   : SEQUENCER_CHIP;
        MUST(sequencer_level(&sequencer) == high, WRONG_VALUE);
        MUST(sequencer_step(&sequencer) == next, WRONG_VALUE);
    }
}

static uint32_t apart(uint32_t a, uint32_t b)
{
    return a > b ? a - b : b - a;
}

/* Pulses at any distance: accepted periods are within 1/8 of the nominal one, and chip times follow
 * from those that are like the one before. */
static void check_clock(struct discipline *clock, const struct tp_node_record *record, uint32_t ticks)
{
    uint32_t nominal = record->frame_period_us * TICKS_PER_US, before = clock->period, last = clock->last;
    bool believed = discipline_period(clock, ticks);
    bool follows = believed && (!last || apart(ticks, last) <= last / 512);
    double chip = (double)record->chip_ns * TICKS_PER_US / 1000;
    double clock_error = (double)clock->period / nominal;

    MUST(clock->period == (follows ? ticks : before), WRONG_VALUE);
    MUST(!believed || follows || apart(ticks, before) <= before / 512, WRONG_VALUE);
    MUST(apart(clock->period, nominal) <= nominal / 8, WRONG_VALUE);
    MUST(discipline_earliest(clock) <= clock->period, WRONG_VALUE);
    double off = clock->chip_q16 - 65536 * chip * (record->discipline ? clock_error : 1);
    MUST(-1 < off && off < 1, WRONG_VALUE);
}

static bool has_news(const struct event *event, const struct tp_node_record *record, uint16_t code)
{
    return (record->follow && apart(code, event->rest) > record->threshold) ||
           apart(code, event->last_sent) > record->threshold;
}

/* The rest moves by one at most, in the frames in which it may, and to the code. */
static void check_rest(const struct event *event, const struct tp_node_record *record, uint16_t before,
                       uint16_t code, uint32_t number)
{
    bool may = record->follow && number % record->follow == 0;
    uint32_t moved = apart(event->rest, before);

    uint32_t off = apart(code, before);
    may = may && (off <= record->threshold || number / record->follow % (1u << (off < 17 ? off - 1 : 16)) == 0);
    MUST(moved == (may && code != before), WRONG_VALUE);
    MUST(!moved || apart(code, event->rest) < apart(code, before), WRONG_VALUE);
}

/* The node transmits while it has news, and once per heartbeat. */
static void check_turns(struct input *input, const struct tp_node_record *record)
{
    struct discipline clock;
    struct event event;
    uint32_t waited = 0; /* frames since the heartbeat */
    uint32_t number = 0; /* of the frame, from 1 */
    bool owed = false;   /* a heartbeat */
    uint16_t rest = input_u16(input) % 1024;

    discipline_init(&clock, record, TICKS_PER_US);
    event_init(&event, record, rest);
    while (input->left) {
        uint8_t kind = input_u8(input);
        uint16_t code = input_u16(input) % 1024;
        bool missed = kind % 8 == 1;
        uint8_t groups = (uint8_t)(1u << kind / 8 % 5), group = input_u8(input) % groups;
        uint8_t turn = groups > 1 ? groups + group : 0;
        bool others = !missed && turn_is_others(turn, record->node);
        MUST(missed || others == (record->node % groups != group), WRONG_VALUE);
        bool due = record->heartbeat && (waited == record->turn);
        bool talks = event_talks(&event, code);
        MUST(talks == (!record->threshold || has_news(&event, record, code) || due || owed), WRONG_VALUE);
        bool spoke = talks && !missed && !others;
        rest = event.rest;
        event_frame(&event, others, spoke, code);
        check_rest(&event, record, rest, code, ++number);
        MUST(!spoke || event.last_sent == code, WRONG_VALUE);
        owed = !spoke && (owed || (due && others));
        waited = due ? (uint32_t)(record->turn - record->heartbeat + 1) : waited + 1;
        uint32_t nominal = record->frame_period_us * TICKS_PER_US;
        check_clock(&clock, record, kind & 0x80 ? input_u32(input) : nominal - nominal / 7 + code * 9u);
    }
}

/* A pulse of any length counts as the nearest valid length within half a unit, else as a glitch. */
static void check_pulse(uint32_t ticks)
{
    uint8_t units = sync_pulse_units(ticks, UNIT_TICKS);

    MUST(units <= TP_SYNC_FRAME, WRONG_VALUE);
    MUST(units == SYNC_PULSE_GLITCH || apart(ticks, units * UNIT_TICKS) <= UNIT_TICKS / 2, WRONG_VALUE);
    for (uint32_t unit = 1; unit <= TP_SYNC_FRAME; unit++)
        MUST(units == unit || apart(ticks, unit * UNIT_TICKS) >= UNIT_TICKS / 2, WRONG_VALUE);
}

/* A pulse stands for a digit within two units of its place. */
static void check_digit(uint32_t ticks)
{
    uint16_t bit = turn_digit(ticks, TP_SYNC_DIGIT * UNIT_TICKS);

    for (uint32_t digit = 0; digit < TURN_DIGITS; digit++) {
        bool there = apart(ticks, (digit + 1) * TP_SYNC_DIGIT * UNIT_TICKS) <= 2 * UNIT_TICKS;
        MUST(there == (bit >> digit & 1), WRONG_VALUE);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    struct input input = {bytes, size};
    struct tp_node_record record;
    uint8_t *row = malloc(ROW_OCTETS);

    check_pulse(input_u32(&input) % (8 * UNIT_TICKS));
    check_digit(input_u32(&input) % (140 * UNIT_TICKS));
    check_pulse(input_u32(&input));
    write_memory(&input);
    enum node_memory_fault fault = node_memory_load(&record, row, limits, read_memory);
    if (fault == NODE_MEMORY_GOOD || fault == NODE_MEMORY_UNFIT)
        check_record(&record, fault == NODE_MEMORY_GOOD);
    if (fault == NODE_MEMORY_GOOD) {
        check_chips(&record, row, input_u16(&input));
        check_turns(&input, &record);
    }
    free(row);
    return 0;
}
