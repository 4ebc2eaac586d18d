// SPDX-License-Identifier: Apache-2.0

/* Reads and checks a node's EEPROM: its configuration and the chips of its code. */
#ifndef TACTILE_NODE_MEMORY_H
#define TACTILE_NODE_MEMORY_H

#include <stdint.h>

#include "board.h"
#include "tactile_protocol.h"

/* Faults of a memory; the number is how often the node's LED blinks. */
enum node_memory_fault {
    NODE_MEMORY_GOOD = 0,
    NODE_MEMORY_BLANK = 1,    /* no record; probably never written */
    NODE_MEMORY_CORRUPT = 2,  /* wrong CRC-32 of record and chips */
    NODE_MEMORY_INVALID = 3,  /* another version, or a field out of range */
    NODE_MEMORY_UNFIT = 4,    /* a valid record beyond this board's struct node_limits */
};

/* Octets of a whole memory: record, code, CRC-32. */
uint16_t node_memory_size(const struct tp_node_record *record);

/* Reads record and row (limits->order / 8 bytes, rounded up, at least 16), which are valid only if the
 * result is GOOD. row: of a sparse code its first octets. */
enum node_memory_fault node_memory_load(struct tp_node_record *record, uint8_t *row,
                                        const struct node_limits *limits,
                                        node_memory_reader *read);

#endif
