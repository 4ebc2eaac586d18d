// SPDX-License-Identifier: Apache-2.0

/* What a digitizer's board is. */
#ifndef TACTILE_BOARD_H
#define TACTILE_BOARD_H

#include <stdint.h>

/* Constant. It must be able to do setup_default. */
struct dg_board {
    uint8_t id[8];         /* unique per board */
    uint32_t ticks_per_us; /* of the sampling clock; up to 1000 */
    uint32_t min_ticks;    /* per sample: the converter's fastest … */
    uint32_t max_ticks;    /* … and slowest rate; below 2²² */
    float volts_per_count; /* V on the line */
    int16_t zero_count;    /* reading at 0 V on the line */
    int16_t min_count;     /* rails of the converter, within 0…4095: */
    int16_t max_count;     /* means are sent as eighths of a count */
};

#endif
