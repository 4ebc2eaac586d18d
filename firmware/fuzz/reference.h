// SPDX-License-Identifier: Apache-2.0

/* A second, simple implementation of docs/protocol.md to compare the core with: packets, settings,
 * samples, and the host of a digitizer. */
#ifndef FUZZ_REFERENCE_H
#define FUZZ_REFERENCE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "board.h"
#include "fuzz.h"
#include "pulses.h"
#include "tactile_protocol.h"

/* The scrambler's next state, whose top octet is the next one of the sequence. */
static inline uint32_t scrambled(uint32_t state)
{
    uint8_t old = (uint8_t)(state ^ state << 1), newest = (uint8_t)(state >> 24);

    return state >> 8 | (uint32_t)(uint8_t)(newest ^ newest >> 3 ^ old ^ old >> 1) << 24;
}

/* ---- framing.c ------------------------------------------------------------------------------- */

/* Encodes and decodes packets as simply as possible. */

#define FRAMING_MAX_RUN (TP_MAX_PACKET - 1)

uint32_t framing_crc(const uint8_t *bytes, size_t size);

/* Decodes a run of bytes between two zeros. body: room for FRAMING_MAX_RUN bytes; receives header and
 * payload. Returns their size, or 0 if the run is not a packet. */
size_t framing_unwrap(const uint8_t *run, size_t size, uint8_t *body);

/* A body with its CRC, COBS and delimiter. wire: room for TP_MAX_PACKET bytes; body: for 4 more than
 * its size. Returns the size. */
size_t framing_wrap(uint8_t *body, size_t size, uint8_t *wire);

/* ---- commands.c ------------------------------------------------------------------------------ */

/* Commands made from an input: whole packets with valid or invalid content. */

#define COMMANDS_MAX 1024 /* bytes on the wire, of two */

/* Bytes that they take in wire are returned. Of the type, without payload; */
size_t commands_plain(struct input *input, uint8_t type, uint8_t *wire);
/* of any type, with any payload; */
size_t commands_any(struct input *input, uint8_t *wire);
/* CONFIGURE that asks for what a board can mostly do. */
size_t commands_configure(struct input *input, const struct dg_board *board, uint8_t *wire);

/* ---- settings.c ------------------------------------------------------------------------------ */

/* The meaning of CONFIGURE by docs/protocol.md, in exact 128-bit numbers. */

__extension__ typedef __int128 wide;

struct settings {
    struct tp_configure asked; /* as it holds: HEAR is DRIVE */
    bool marked;
    uint32_t ticks_per_us, ticks_per_sample;
    uint32_t chips;      /* coded ones in a frame */
    wide first_mark;     /* thousandths of a tick, as all that follows */
    wide period, chip;
    uint32_t quiet_counts;
};

/* The result that the digitizer must return. settings: those in force if it is OK. */
enum tp_result settings_of(struct settings *settings, const struct dg_board *board,
                           const struct tp_configure *asked);

/* Start of a chip, from the frame's mark. */
wide settings_chip(const struct settings *settings, uint32_t chip);

/* Whether 832 µs or more lie between a frame's end and the next one, and these are marked; 960 µs. */
bool settings_has_turns(const struct settings *settings);
bool settings_can_ask(const struct settings *settings);
bool settings_has_numbers(const struct settings *settings);

/* Number of the first sample at or after a time. */
uint64_t settings_sample(const struct settings *settings, wide time);

/* First sample of frame number `frame`. */
uint64_t settings_mark(const struct settings *settings, uint64_t frame);

/* A time in µs, to the nearest. */
uint64_t settings_us(const struct settings *settings, wide time);

/* ---- line.c ---------------------------------------------------------------------------------- */

/* Records a stream's samples and checks the packets that report them. */

struct line {
    struct settings settings;
    uint64_t start_us;
    uint16_t *counts; /* LINE_LOST: could not be kept */
    size_t size, capacity;
    uint64_t frame; /* that the next pulse belongs to … */
    uint32_t chip;  /* … and announces */
    uint8_t *turn;  /* by frame, and 32 where all are asked to speak */
    size_t frames;  /* room for so many there */
    bool begun;     /* the next frame's first pulse has been taken */
    uint16_t digits; /* whose pulses are still due before it */
    uint8_t log2_groups, group; /* in force; the next frame's */
    uint8_t asked_for; /* frames from the next one on in which all are asked to speak */
    uint64_t next;  /* index of the word after the last one that was told of */
    struct dg_pulse *pulses; /* of the data wire: those taken, … */
    size_t taken, over;      /* … how many, and how many of them are over */
    uint16_t rest, swing;    /* the sample before the present pulse; counts that it moves the wire at least */
    bool follows;            /* it has, or this cannot be said */
    uint32_t unseen;         /* frames' pulses of which it can, and has not */
};

#define LINE_LOST UINT16_MAX

/* SAMPLES, or QUIET. */
struct line_packet {
    uint64_t device_time_us, first;
    uint8_t flags;
    uint32_t count;
    const uint8_t *words; /* as on the wire; NULL: QUIET, with these sums: */
    int64_t sum;
    uint64_t sum_of_squares;
};

void line_init(struct line *line, const struct settings *settings, uint64_t start_us);
void line_free(struct line *line);

/* Samples of the converter; counts NULL: lost ones. */
void line_add(struct line *line, const uint16_t *counts, size_t size);

/* What a frame is to say: groups, a number, and in how many turns all are to speak, which is said once; -1: none. */
struct wishes {
    uint8_t log2_groups;
    uint16_t number; /* in the digits of a turn; 0: none */
    int8_t words_log2;
};

/* The next pulse. */
void line_pulse(struct line *line, const struct dg_pulse *pulse, struct wishes *wishes);
/* So many samples come before what the next pulse announces. */
uint64_t line_covered(const struct line *line);
/* Frames by which pulses are ahead of the samples. */
uint64_t line_ahead(const struct line *line);

/* The next packet. dropped: whether packets before it were dropped. */
void line_check(struct line *line, const struct line_packet *packet, bool dropped);
/* The stream was sent completely, and nothing was dropped. */
void line_check_end(const struct line *line);
/* Number of words so far that are missing because samples were lost. */
uint32_t line_lost(const struct line *line);

/* ---- host.c ---------------------------------------------------------------------------------- */

/* The host of a fuzzed digitizer: knows the answers due to the bytes that it sends and compares them
 * with those received. */

/* An ACK that is due. */
struct host_answer {
    struct tp_ack ack;
    bool info;                /* and INFO after it … */
    struct settings settings; /* … which says this */
    bool packed;              /* samples that follow are PACKED */
};

/* Bytes up to a zero. */
struct host_run {
    uint8_t bytes[FRAMING_MAX_RUN];
    size_t size; /* also beyond what is kept */
};

struct host {
    const struct dg_board *board;
    struct settings settings; /* that must hold now */
    bool running;             /* … */
    bool restarted;           /* since the harness has looked */
    struct wishes wishes;
    bool packs;               /* packed samples were asked for since the last CONFIGURE */
    uint32_t refused, errors;
    struct host_run sent;

    struct host_answer *answers; /* due, in this order */
    size_t answers_size, answered;
    struct host_run heard;
    uint64_t heard_size;    /* bytes, zeros too */
    uint64_t packet_begin;  /* of the packet in progress: its place among them */
    uint16_t sequence;      /* of the next packet */
    uint32_t missing;       /* packets, by their sequence */
    uint32_t unanswered;    /* commands whose ACK is among them */
    bool info_due;
    struct tp_status status; /* the latest */

    /* Called with all packets of samples. place: offset of the packet in the bytes received. */
    void (*samples)(void *context, const struct line_packet *packet, uint64_t place);
    void *context;
};

void host_init(struct host *host, const struct dg_board *board);
void host_free(struct host *host);

/* Notes bytes sent to the digitizer. */
void host_sends(struct host *host, const uint8_t *bytes, size_t size);
/* Checks bytes received from it. */
void host_hears(struct host *host, const uint8_t *bytes, size_t size);
/* Everything it sent has been received, a STATUS last. */
void host_check_end(const struct host *host);

#endif
