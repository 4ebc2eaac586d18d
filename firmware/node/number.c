// SPDX-License-Identifier: Apache-2.0

#include "number.h"

#include "node_board.h"
#include "turn.h"

#define FIRST (uint16_t)sizeof(struct tp_node_table)
/* Frames in a row that must say the same of a number. Chosen: more than disturbances do. */
#define STEADY 8u

static uint16_t place; /* in the table: of the memory that flash_byte reads */
static uint16_t count; /* memories in the table */
static bool lacks;

static uint16_t last;  /* turn */
static uint8_t steady; /* frames that it has been the same */
static uint16_t left;  /* octets of a memory that the EEPROM still has to take */

static uint8_t flash_byte(uint16_t address)
{
    return board_flash_byte(place + address);
}

/* Reads the first memory of the table. */
static enum node_memory_fault load_first(struct tp_node_record *record, uint8_t *row,
                                         const struct node_limits *limits)
{
    place = FIRST;
    lacks = count > 1;
    return node_memory_load(record, row, limits, flash_byte);
}

enum node_memory_fault number_load(struct tp_node_record *record, uint8_t *row,
                                   const struct node_limits *limits)
{
    enum node_memory_fault fault = node_memory_load(record, row, limits, board_memory_byte), other;

    if (!BOARD_LARGE)
        return fault;
    count = (uint16_t)(board_flash_byte(0) | board_flash_byte(1) << 8);
    if (count == UINT16_MAX)
        count = 0;
    if (fault == NODE_MEMORY_GOOD)
        return fault;
    other = load_first(record, row, limits);
    /* of two faults that of the memory which somebody wrote, or tried to */
    return other == NODE_MEMORY_GOOD || other > fault ? other : fault;
}

bool number_lacks(void)
{
    return BOARD_LARGE && lacks;
}

/* An octet of the memory, at every frame; after the last one the node has its number if all are there. */
static bool save(struct tp_node_record *record, uint8_t *row, const struct node_limits *limits)
{
    uint16_t at = node_memory_size(record) - left;

    board_memory_write(at, flash_byte(at));
    if (--left)
        return false;
    lacks = node_memory_load(record, row, limits, board_memory_byte) != NODE_MEMORY_GOOD;
    if (lacks)
        load_first(record, row, limits);
    return true;
}

bool number_heard(uint16_t turn, bool pressed, struct tp_node_record *record, uint8_t *row,
                  const struct node_limits *limits)
{
    uint16_t number = turn_number(turn) & ((1u << TP_TURN_NUMBER_BITS) - 1u);

    if (!BOARD_LARGE || count < 2)
        return false;
    if (left && turn == last)
        return save(record, row, limits);
    left = 0; /* another has taken it meanwhile; what is in the EEPROM so far has no CRC */
    if (turn != last)
        steady = 0;
    else if (steady < STEADY)
        steady++;
    last = turn;
    if (steady < STEADY || !turn_has_number(turn))
        return false;
    if (turn & TP_TURN_FORGET) {
        if (lacks || (number && number != record->node))
            return false;
        board_memory_write(0, 0xFF); /* which is no record's first octet */
        load_first(record, row, limits);
        return true;
    }
    if (lacks && pressed && number && number <= count) {
        left = node_memory_size(record);
        place = FIRST + (number - 1u) * left;
    }
    return false;
}
