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
