// SPDX-License-Identifier: Apache-2.0

/* Sixteen pins as nodes: a PIO state machine waits for each pulse on the sync line, then puts out the
 * chips of a frame, which DMA feeds it. */
#ifndef RP2040_DEMO_PINS_H
#define RP2040_DEMO_PINS_H

#include <stdbool.h>
#include <stdint.h>

/* Releases all pins. */
void pins_init(void);
/* Whether resistors join pins and converter: the line follows the pins. Before sampling starts. */
bool pins_are_wired(void);

/* Waits for a pulse. chip_us: duration of a chip. */
void pins_start(uint32_t chip_us);
/* Releases all pins, whatever they do. */
void pins_stop(void);
/* Whether all chips of the latest frame have been handed over: time to plan the next one. */
bool pins_want_frame(void);
/* Puts out `count` chips after the next pulse: levels of the 16 pins, and in the upper half which of
 * them are driven. The last one stays. */
void pins_play(const uint32_t *chips, uint32_t count);
/* Whether a frame came too late since the start: after its pulse, or in part. */
bool pins_failed(void);

#endif
