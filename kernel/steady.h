// SPDX-License-Identifier: Apache-2.0

/* Follows a stream of marked frames while it goes on as it was: packets that continue it, frames that
 * the timing of an earlier one explains, gaps of which level and noise at rest are learnt. It is what
 * Timeline.accept, MarkedTiming and MarkedLine do, as far as there is nothing to decide. Whatever else
 * comes ends it, and is left to them: nothing of it has been taken in. */
#ifndef TACTILE_STEADY_H
#define TACTILE_STEADY_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "carried.h"
#include "scanner.h"

#define STEADY_MOST_PASSED 64 /* packets between two events */

/* Of a stream; see Pace and MarkedLine. */
struct steady_setting {
    struct carried_line line;
    float zero, per_count;     /* count → V */
    double zero_count, volts_per_count; /* the same, of means of counts */
    double most_volts;         /* a sample beyond is absurd */
    size_t gap_size;           /* most samples before a mark that are looked at */
    size_t least_rest;         /* gap samples that an estimate takes */
    double gap_weight, rise, rise_v2; /* as GAP_WEIGHT, Limits.rise; V² that it may rise besides */
    size_t silent_over;        /* samples from the mark to the end of a silent frame */
    double rate_hz, behind_s, ahead_s, ahead; /* by which device time may be off; see Pace.fits */
    uint64_t most_device_us;
    double most_quiet, most_quiet_v2; /* samples; variance, V² */
};

/* The place of a stream: everything that a packet changes. Indices are of the stream's samples. */
struct steady_place {
    int64_t end;                  /* of what was taken in */
    int64_t start, gap_begin;     /* of the frame in progress, and of the gap; -1: none */
    int64_t mark;                 /* the last one */
    uint64_t last_us;             /* device time of the last packet, */
    uint32_t last_count;          /* and its samples */
    double level, noise;          /* of the line at rest, V; variance of a chip's level, V² */
    double gap_count, gap_sum, gap_squares; /* not evaluated yet */
};

/* How frames are read now. */
struct steady_timing {
    const struct carried_fit *fit; /* NULL where only silent frames are taken */
    size_t due, over;              /* samples from the mark on until it can be decided, and is over */
    size_t most_uses;
};

/* A packet that was taken in. */
struct steady_passed {
    int64_t index;
    uint64_t device_time_us;
    uint32_t count;
    uint16_t sequence;
    bool backlog;
    double t_host;
};

enum steady_event {
    STEADY_MORE,      /* more bytes are needed */
    STEADY_HEARD,     /* a frame in which nodes spoke; its correlations are in `rows` */
    STEADY_SILENT,    /* one in which none did */
    STEADY_FULL,      /* STEADY_MOST_PASSED packets passed; nothing else */
    STEADY_PACKET,    /* a packet, which was not taken in */
    STEADY_UNDECIDED, /* the frame in progress is there, but not decided */
};

struct steady;

/* scanner and setting->line.transform: are kept. rows: (k, N), kept and written to. NULL: no memory. */
struct steady *steady_new(const struct steady_setting *setting, struct scanner *scanner, float *rows);
void steady_free(struct steady *steady);

/* Goes on from a place between frames. origin: the digitizer's index of index 0. volts: of the samples
 * before the place. timing: its fit is kept. False: no memory. */
bool steady_enter(struct steady *steady, const struct steady_place *place, uint64_t origin,
                  const struct steady_timing *timing, const double *volts, size_t count);

/* Bytes to go on with, kept until they are used up; read at t_host, s. backlog: they had waited. */
void steady_give(struct steady *steady, const uint8_t *bytes, size_t size, double t_host, bool backlog);
/* Those that are not used up. */
size_t steady_left(const struct steady *steady, const uint8_t **bytes);

/* Goes on up to the next event. packet: of STEADY_PACKET. */
enum steady_event steady_next(struct steady *steady, struct scanner_packet *packet);

/* Of the last event. */
const struct carried_found *steady_found(const struct steady *steady);
/* Start of the frame that was just decided. */
int64_t steady_start(const struct steady *steady);
const struct steady_place *steady_place(const struct steady *steady);
/* How often the timing was used, and how many frames began, since the place was entered. */
size_t steady_uses(const struct steady *steady);
size_t steady_marks(const struct steady *steady);

/* The packets that passed since the last call. */
size_t steady_passed(struct steady *steady, const struct steady_passed **passed);
/* Samples from index `begin` on, as far as they are kept; *begin becomes the index of the first one. */
size_t steady_samples(const struct steady *steady, int64_t *begin, const double **volts);

#endif
