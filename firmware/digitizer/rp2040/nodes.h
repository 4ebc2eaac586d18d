// SPDX-License-Identifier: Apache-2.0

/* Where the nodes are: elsewhere, on the wire (nodes_elsewhere.c, a digitizer), or on this board
 * (demo/nodes_here.c, a demonstrator). */
#ifndef RP2040_NODES_H
#define RP2040_NODES_H

#include "digitizer.h"

extern const char nodes_product[]; /* the device's name on USB */
/* Hosts that can be reached without the nodes' pins, as in struct dg_hardware. */
extern const struct dg_link nodes_links[];
extern const size_t nodes_link_count;

/* At power-up. Changes what is different about this board. */
void nodes_init(struct dg_board *board);
/* What the board and its nodes take from USB at most, mA; after nodes_init. */
uint32_t nodes_current_ma(void);
/* The stream has ended. */
void nodes_stop(void);
/* A stream will begin: before its first sample and pulse. */
void nodes_begin(struct dg *dg);
/* The next pulse on the sync line, as dg_pulse gives it. May be called from an interrupt. */
bool nodes_pulse(struct dg *dg, struct dg_pulse *pulse);
/* These are take_samples and pulses_failed of struct dg_hardware. */
size_t nodes_take(const uint16_t **samples, uint32_t *lost);
bool nodes_failed(void);
/* This is command of struct dg_board. */
enum tp_result nodes_obey(uint8_t type, const uint8_t *payload, size_t size);

#endif
