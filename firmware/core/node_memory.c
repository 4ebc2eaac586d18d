// SPDX-License-Identifier: Apache-2.0

#include "node_memory.h"

#include "crc32.h"
#include "frame.h"
#include "sparse_code.h"

/* Largest order that a record may have: bounds the bytes read before the CRC is known to be right. */
#define MAX_ORDER 4096u

/* Octets that follow the record. */
static uint16_t octets(const struct tp_node_record *record)
{
    return record->digits ? record->digits : (uint16_t)((record->order + 7u) / 8u);
}

uint16_t node_memory_size(const struct tp_node_record *record)
{
    return (uint16_t)(sizeof *record + octets(record) + sizeof(uint32_t));
}

static bool intact(const struct tp_node_record *record, node_memory_reader *read)
{
    uint16_t size = node_memory_size(record);
    uint32_t crc = 0;

    for (uint16_t address = 0; address < size; address++) {
        uint8_t byte = read(address);

        crc = crc32_update(crc, &byte, 1);
    }
    return crc == CRC32_RESIDUE;
}

static bool fits(const struct tp_node_record *record, const struct node_limits *limits)
{
    uint32_t chips = (uint32_t)frame_line_bits(record->bits, record->parity) * record->order;
    uint32_t span = frame_span(chips, record->resync_chips, record->guard_chips);
    uint64_t used_ns = (uint64_t)span * record->chip_ns +
                       1000ul * (TP_SYNC_LEAD * TP_SYNC_UNIT_US + limits->measuring_us);
    uint32_t guard_ns = record->guard_chips * record->chip_ns;
    uint16_t least_ns = record->scramble ? limits->scrambled_chip_ns : limits->chip_ns;

    if (record->digits)
        least_ns = limits->sparse_chip_ns;
    return (record->digits ? limits->sparse_chip_ns > 0 : record->order <= limits->order) &&
           record->chip_ns >= least_ns && record->chip_ns <= limits->longest_chip_ns &&
           record->chip_ns % limits->chip_step_ns == 0 &&
           (limits->bits_restart ? record->resync_chips == record->order && record->order % 2 == 0
                                 : !record->digits || !record->resync_chips) &&
           used_ns <= 1000u * (uint64_t)record->frame_period_us &&
           (span == chips || guard_ns >= 1000ul * limits->restart_us);
}

enum node_memory_fault node_memory_load(struct tp_node_record *record, uint8_t *row,
                                        const struct node_limits *limits, node_memory_reader *read)
{
    uint8_t *bytes = (uint8_t *)record;
    uint16_t address;

    for (address = 0; address < sizeof *record; address++)
        bytes[address] = read(address);
    if (record->magic != TP_NODE_MAGIC)
        return NODE_MEMORY_BLANK;
    if (!(limits->hears_own && record->version == TP_NODE_VERSION) &&
        !(limits->hears_data && record->version == TP_NODE_VERSION_DATA))
        return NODE_MEMORY_INVALID;
    if (record->order > MAX_ORDER || !intact(record, read))
        return NODE_MEMORY_CORRUPT;
    if (!tp_node_record_in_range(record) || record->node > record->nodes ||
        !record->resync_chips != !record->guard_chips ||
        (record->digits && record->digits < SPARSE_LEAST_DIGITS))
        return NODE_MEMORY_INVALID;
    if (!fits(record, limits))
        return NODE_MEMORY_UNFIT;
    for (uint16_t octet = 0; octet < octets(record); octet++)
        row[octet] = read(address++);
    return NODE_MEMORY_GOOD;
}
