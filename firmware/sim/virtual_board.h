// SPDX-License-Identifier: Apache-2.0

/* A digitizer's board for the emulated skin: the portable core on virtual hardware.
 *
 * Its 48 MHz clock times the converter, the sync pulses and the device time. The converter has 12 bits
 * from 0 to 3.3 V and samples the skin's line at exact instants; pulses reach the nodes at theirs.
 * Output waits in the core's ring for a link of limited speed.
 *
 * Nodes and board take turns in steps of STEP_NS: pulses are announced before a step, samples passed on
 * and bytes sent after it. */
#ifndef VIRTUAL_BOARD_H
#define VIRTUAL_BOARD_H

#include "skin.h"

struct virtual_board;

/* clock_error: relative error of its oscillator; 0.01 is 1 % fast. link_rate: bytes/s; 0: unlimited. */
struct virtual_board *board_create(struct skin *skin, double offset_v, double clock_error,
                                   double link_rate);
void board_free(struct virtual_board *board);

/* Runs board and nodes to a time. */
void board_run(struct virtual_board *board, int64_t t_ns);

/* Delivers bytes from the host now. */
void board_write(struct virtual_board *board, const uint8_t *bytes, size_t size);
/* Takes bytes that the host has received, each once; returns their number. */
size_t board_read(struct virtual_board *board, uint8_t *bytes, size_t size);

#endif
