// SPDX-License-Identifier: Apache-2.0

#include "number.h"

#include <string.h>

#include "node_board.h"
#include "turn.h"

#define FIRST (uint16_t)sizeof(struct tp_node_table)
/* Frames in a row that must say the same of a number. Chosen: more than disturbances do. */
#define STEADY 8u

static uint16_t place; /* in the table: of the memory that flash_byte reads */
static uint16_t before; /* octets of the memories of the sensors before the one whose memory is read */
static uint16_t count; /* memories in the table */
static bool lacks;

static uint16_t last;  /* turn */
static uint8_t steady; /* frames that it has been the same */
static uint16_t left;  /* octets of a memory that the EEPROM still has to take */

static uint8_t flash_byte(uint16_t address)
{
    return board_flash_byte(place + (BOARD_SENSORS == 1 ? 0 : before) + address);
}

static uint8_t eeprom_byte(uint16_t address)
{
    return board_memory_byte(before + address);
}

/* Whether a sensor's record is that of the first one but for its number and its row. */
static bool is_alike(const struct tp_node_record *first, const struct tp_node_record *record, uint8_t sensor)
{
    const size_t from = offsetof(struct tp_node_record, bits), to = offsetof(struct tp_node_record, rest);

    return record->node == first->node + sensor && record->version == first->version &&
           memcmp((const uint8_t *)first + from, (const uint8_t *)record + from, to - from) == 0;
}

/* Reads the memory of each sensor; of several they follow each other. */
static enum node_memory_fault load(struct tp_node_record *record, uint8_t *row, const struct node_limits *limits,
                                   node_memory_reader *read)
{
    if (BOARD_SENSORS == 1)
        return node_memory_load(record, row, limits, read);
    before = 0;
    for (uint8_t s = 0; s < BOARD_SENSORS; s++) {
        enum node_memory_fault fault = node_memory_load(&record[s], row + s * BOARD_ROW, limits, read);

        if (fault)
            return fault;
        if (!is_alike(record, &record[s], s))
            return NODE_MEMORY_INVALID;
        before += node_memory_size(&record[s]);
    }
    return NODE_MEMORY_GOOD;
}

/* Reads the first memory of the table. */
static enum node_memory_fault load_first(struct tp_node_record *record, uint8_t *row,
                                         const struct node_limits *limits)
{
    place = FIRST;
    lacks = count > 1;
    return load(record, row, limits, flash_byte);
}

enum node_memory_fault number_load(struct tp_node_record *record, uint8_t *row,
                                   const struct node_limits *limits)
{
    enum node_memory_fault fault, other;

    if (!BOARD_LARGE)
        return node_memory_load(record, row, limits, board_memory_byte);
    count = (uint16_t)(board_flash_byte(0) | board_flash_byte(1) << 8);
    if (count == UINT16_MAX)
        count = 0;
    /* whoever flashed a number means it, whatever the EEPROM has from before */
    if (count == 1 && load_first(record, row, limits) == NODE_MEMORY_GOOD)
        return NODE_MEMORY_GOOD;
    fault = load(record, row, limits, BOARD_SENSORS == 1 ? board_memory_byte : eeprom_byte);
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

    if (!BOARD_TAKES_NUMBER || count < 2)
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
