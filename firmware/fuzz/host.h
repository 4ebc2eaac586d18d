// SPDX-License-Identifier: Apache-2.0

/* The host of a digitizer that is fuzzed: knows what must be answered to the bytes that it sends, and
 * holds against it what comes back. */
#ifndef FUZZ_HOST_H
#define FUZZ_HOST_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "board.h"
#include "framing.h"
#include "line.h"
#include "settings.h"

/* An ACK that must come. */
struct host_answer {
    struct tp_ack ack;
    bool info;                /* and INFO after it … */
    struct settings settings; /* … which says this */
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
    bool call_asked;          /* … and not yet begun */
    uint32_t refused, errors;
    struct host_run sent;

    struct host_answer *answers; /* that must come, in their order */
    size_t answers_size, answered;
    struct host_run heard;
    uint64_t heard_size;    /* bytes, zeros too */
    uint64_t packet_begin;  /* of the packet in progress: its place among them */
    uint16_t sequence;      /* of the next packet */
    uint32_t missing;       /* packets, by their sequence */
    uint32_t unanswered;    /* commands whose ACK is among them */
    bool info_due;
    struct tp_status status; /* the latest */

    /* Is told of all samples. place: of the packet among the bytes heard. */
    void (*samples)(void *context, const struct line_packet *packet, uint64_t place);
    void *context;
};

void host_init(struct host *host, const struct dg_board *board);
void host_free(struct host *host);

/* Bytes that the digitizer gets. */
void host_sends(struct host *host, const uint8_t *bytes, size_t size);
/* Bytes that it has sent. */
void host_hears(struct host *host, const uint8_t *bytes, size_t size);
/* All that it has sent was heard, and after all else a STATUS. */
void host_check_end(const struct host *host);

#endif
