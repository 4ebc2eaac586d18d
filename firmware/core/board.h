// SPDX-License-Identifier: Apache-2.0

/* Everything that a board must supply to the portable core, as data and as functions.
 *
 * No file in core/ includes a header from another folder: boards include the core, never the
 * reverse. A digitizer supplies struct dg_board and, if it uses the loop of loop.h, struct
 * dg_hardware. A board may instead call the functions of digitizer.h from a loop of its own. A node
 * supplies struct node_limits and a node_memory_reader.
 */
#ifndef TACTILE_BOARD_H
#define TACTILE_BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "tactile_protocol.h"

struct dg;

/* The digitizer's clock and converter. Constant; setup_default must be possible with it. */
struct dg_board {
    uint8_t id[8];         /* unique per board */
    uint32_t ticks_per_us; /* of the sampling clock; up to 1000 */
    uint32_t min_ticks;    /* sampling period at the converter's fastest rate, ticks */
    uint32_t max_ticks;    /* … and at its slowest; below 2²² */
    float volts_per_count; /* V on the line */
    int16_t zero_count;    /* reading at 0 V on the line */
    int16_t min_count;     /* rails of the converter, within 0…4095, because a mean is sent in */
    int16_t max_count;     /* eighths of a count and must fit 16 bits */
    /* Executes a command that not every board knows; UNKNOWN_COMMAND: nor does this one. NULL: none. */
    enum tp_result (*command)(uint8_t type, const uint8_t *payload, size_t size);
    /* The only layout that its nodes know, but for samples_per_chip; NULL: any. */
    const struct tp_frame_layout *layout;
    bool wireless; /* its samples are of no line that it could pull low */
    bool hears;    /* it tells of another digitizer's frames (dg_heard) */
};

/* Bytes: a serial link to a host. None of these functions waits. */
struct dg_link {
    /* Whether a host listens, as far as the link can tell. */
    bool (*ready)(void);
    /* Moves received bytes, at most `size`, into `bytes`; returns their number. */
    size_t (*read)(uint8_t *bytes, size_t size);
    /* Starts to send. The bytes stay in place while sending(). A size of 0 says that no bytes follow
     * for now, for links that need to tell their host. */
    void (*send)(const uint8_t *bytes, size_t size);
    bool (*sending)(void);
    /* Gives up sending; returns how many bytes were not sent. A link that cannot give up returns 0
     * and goes on sending. */
    size_t (*cancel)(void);
};

#define DG_CHUNK 256u /* samples that take_samples returns at most: bounds the time of one pass */

/* The digitizer's hardware, called by loop.c from one context. */
struct dg_hardware {
    /* Time: µs since power-up. */
    uint64_t (*time_us)(void);
    /* Wake: sleeps until an interrupt has work for the loop (bytes, a sync fault, a tick of the
     * board's timer). Returns at once if one has had since the last call; may return early. */
    void (*sleep)(void);
    /* Bytes: links in order of preference; the last one is taken where none is ready. */
    const struct dg_link *links;
    size_t link_count;

    /* Samples and pulses: stops both; then, if dg->running, samples every dg->ticks_per_sample,
     * calls dg_begin with the time of tick 0, and makes the pulses that dg_pulse gives. */
    void (*restart)(struct dg *dg);
    /* The next samples, at most DG_CHUNK, which stay in place until release_samples; sets *lost to
     * the number of samples lost before them. */
    size_t (*take_samples)(const uint16_t **counts, uint32_t *lost);
    void (*release_samples)(size_t size);
    /* Takes no further samples; those taken can still be read. */
    void (*pause_samples)(void);
    /* Whether a pulse could not be made in time since the last restart. */
    bool (*pulses_failed)(void);
};

/* What a node's board can do. */
struct node_limits {
    uint16_t order;           /* longest code row it has room for, chips */
    uint16_t chip_ns;         /* shortest chip, … */
    uint16_t scrambled_chip_ns; /* … if it is flipped, … */
    uint16_t sparse_chip_ns;  /* … or of a sparse code, 0: it has none … */
    uint32_t longest_chip_ns; /* … and longest */
    uint16_t chip_step_ns;    /* chips are a multiple of this */
    bool bits_restart;        /* a sub-slot must be a bit */
    uint16_t measuring_us;    /* shortest time from a frame's end to the next sync pulse */
    uint16_t restart_us;      /* shortest time from a sub-slot's end to the next sub-slot */
    bool hears_own;           /* hears sync pulses on a wire of their own, … */
    bool hears_data;          /* … and on the data wire */
};

/* Reads byte `address` of a node's memory. */
typedef uint8_t node_memory_reader(uint16_t address);

#endif
