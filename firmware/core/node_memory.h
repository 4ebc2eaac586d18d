// SPDX-License-Identifier: Apache-2.0

/* What a node knows about itself and its skin: read from its EEPROM, believed only if all is right. */
#ifndef TACTILE_NODE_MEMORY_H
#define TACTILE_NODE_MEMORY_H

#include <stdint.h>

#include "tactile_protocol.h"

/* What is wrong with a memory; the node's LED blinks so often. */
enum node_memory_fault {
    NODE_MEMORY_GOOD = 0,
    NODE_MEMORY_BLANK = 1,    /* no record: never written? */
    NODE_MEMORY_CORRUPT = 2,  /* chips or record don't fit their CRC-32 */
    NODE_MEMORY_INVALID = 3,  /* another version, or a field out of range: written by other software? */
    NODE_MEMORY_UNFIT = 4,    /* a good record, but too much for this board: see struct node_limits */
};

/* What a board can do. */
struct node_limits {
    uint16_t order;          /* chips of a row that it has room for */
    uint16_t chip_ns;        /* least duration of a chip */
    uint16_t measuring_us;   /* it needs so long between a frame's end and the next sync pulse */
    uint16_t restart_us;     /* … and between a sub-slot's end and the next sub-slot */
};

/* Byte `address` of the memory. */
typedef uint8_t node_memory_reader(uint16_t address);

/* Reads record and row (limits->order / 8 bytes, rounded up). Unless the result is GOOD, both are
 * meaningless. */
enum node_memory_fault node_memory_load(struct tp_node_record *record, uint8_t *row,
                                        const struct node_limits *limits,
                                        node_memory_reader *read);

#endif
