// SPDX-License-Identifier: Apache-2.0

#include "number.h"

#include "node_board.h"

static uint16_t place; /* in the table: of the memory that memory_byte reads */

static uint8_t memory_byte(uint16_t address)
{
    return board_flash_byte(place + address);
}

enum node_memory_fault number_load(struct tp_node_record *record, uint8_t *row,
                                   const struct node_limits *limits)
{
    enum node_memory_fault fault = node_memory_load(record, row, limits, board_memory_byte), other;

    if (!BOARD_LARGE || fault == NODE_MEMORY_GOOD)
        return fault;
    place = sizeof(struct tp_node_table);
    other = node_memory_load(record, row, limits, memory_byte);
    /* of two faults that of the memory which somebody wrote, or tried to */
    return other == NODE_MEMORY_GOOD || other > fault ? other : fault;
}
