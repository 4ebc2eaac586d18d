// SPDX-License-Identifier: Apache-2.0

/* Commands made of an input: whole packets, whatever they say. */
#ifndef FUZZ_COMMANDS_H
#define FUZZ_COMMANDS_H

#include "board.h"
#include "input.h"

#define COMMANDS_MAX 1024 /* bytes on the wire, of two */

/* Bytes that they take in wire are returned. Of the type, without payload; */
size_t commands_plain(struct input *input, uint8_t type, uint8_t *wire);
/* of any type, with any payload; */
size_t commands_any(struct input *input, uint8_t *wire);
/* CONFIGURE that asks for what a board can mostly do. */
size_t commands_configure(struct input *input, const struct dg_board *board, uint8_t *wire);

#endif
