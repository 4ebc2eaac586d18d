// Copyright 2026 tactile_cdma maintainers
//
// Licensed under the Apache License, Version 2.0 (the "License");
// you may not use this file except in compliance with the License.
// You may obtain a copy of the License at
//
//     http://www.apache.org/licenses/LICENSE-2.0
//
// Unless required by applicable law or agreed to in writing, software
// distributed under the License is distributed on an "AS IS" BASIS,
// WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
// See the License for the specific language governing permissions and
// limitations under the License.

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
