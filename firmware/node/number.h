// SPDX-License-Identifier: Apache-2.0

/* Where a node gets its record from, and with it its number: the EEPROM, or else the flash. */
#ifndef NODE_NUMBER_H
#define NODE_NUMBER_H

#include <stdbool.h>
#include <stdint.h>

#include "node_memory.h"

/* Reads record and row as node_memory_load does. */
enum node_memory_fault number_load(struct tp_node_record *record, uint8_t *row,
                                   const struct node_limits *limits);

#endif
