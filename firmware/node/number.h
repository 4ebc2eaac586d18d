// SPDX-License-Identifier: Apache-2.0

/* Where a node gets its record from, and with it its number: the EEPROM, or else the flash.
 *
 * One image may hold the memories of all nodes of a skin. Its node has no number, and is silent, until the
 * digitizer announces one while its sensor is pressed: it keeps the memory of that number in its EEPROM.
 */
#ifndef NODE_NUMBER_H
#define NODE_NUMBER_H

#include <stdbool.h>
#include <stdint.h>

#include "node_memory.h"

/* Reads record and row as node_memory_load does. */
enum node_memory_fault number_load(struct tp_node_record *record, uint8_t *row,
                                   const struct node_limits *limits);

/* Whether it has no number; then the record is that of another node. */
bool number_lacks(void);

/* Takes in the turn of a frame, and whether the sensor is pressed in it. Returns whether record and row are
 * others now. */
bool number_heard(uint16_t turn, bool pressed, struct tp_node_record *record, uint8_t *row,
                  const struct node_limits *limits);

#endif
