// SPDX-License-Identifier: Apache-2.0

/* A sensing node that runs its real image: an AVR under simavr, on the skin's time axis.
 *
 * Time is in ns and common to all nodes; each has a clock of its own. simavr 1.6 is exact per
 * instruction but not at its pins, so the following is done here, according to the data sheets:
 *
 *   - Timers and edges of the sync line act at their own cycle, not after the instruction that they
 *     fall into, or one cycle late out of sleep.
 *   - The output pin: DDR bit clear is released; else the latch of output compare A where a compare
 *     output mode is set, else the PORT bit. Writes act as their instruction ends. Only matches and
 *     FOC1A change the latch (simavr also changes it on overflow, and PORT with it).
 *     Of four sensors each has such a pin, PD2 to PD5, without a latch.
 *   - An interrupt takes 4 cycles before its vector, 4 more out of sleep (simavr: none).
 *   - Ones written to a timer's or INT0's flag register clear these flags (simavr: all flags of the
 *     timer, none of INT0), and these interrupts then wait no longer (simavr: their places in its
 *     queue stay taken); enabling an interrupt whose flag is set raises it (simavr: never).
 *   - Timer1's noise canceller delays an edge by 4 cycles, and drops a shorter pulse (simavr: has none).
 *   - On the data wire AIN1 is the line's pin: what the node drives, or the line, after the delay of its resistor and
 *     of the comparator; the comparator is simavr's, whose bandgap is fixed, so that voltages are scaled instead.
 *     Its register keeps ACO, and a one clears ACI (simavr: as written).
 *   - The USART as master of a serial bus: avr_usart.h.
 *   - CLKPR divides the clock, whose frequency is that of a crystal.
 *   - SLEEP does nothing without SE. The ATtiny85's Timer1 counts, to 255.
 *   - The converter's code is ⌊1024 · V / AVcc⌋; its only reference is AVcc.
 *
 * Left out: delays of the input synchronisers, PRR, fuses, brown-out, sleep
 * modes other than idle (they are counted). SBI on a PIN register toggles, as in simavr, all bits
 * that are set; a timer is read as it is when the reading instruction begins.
 */
#ifndef AVR_NODE_H
#define AVR_NODE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "sync_line.h"

/* The output pin changed. */
struct pin_edge {
    int64_t t_ns;
    int8_t level; /* +1 high, −1 low, 0 released */
};

/* Since power-up. */
struct node_counters {
    uint64_t cycles_awake, cycles_asleep;
    uint32_t watchdog_resets;
    uint32_t deep_sleeps; /* in a mode other than idle, for which the emulation is not valid */
    uint32_t pull_ups;    /* times that an output pin was released into its pull-up, for more than a cycle */
    uint32_t faults;      /* errors that simavr reports: bad addresses, bad opcodes, a crash; and times that it
                           * drove a pin against its sync line */
};

/* Description of a node. */
struct node_plan {
    const char *image, *mcu;
    const uint8_t *flash;  /* its whole flash up to the last byte written, where image is no ELF file */
    size_t flash_size;
    const uint8_t *memory; /* beginning of its EEPROM; the rest is blank */
    size_t memory_size;
    double clock_hz;
    double supply_v;
    double gain;      /* of its input of the amplifier */
    int64_t start_ns; /* when it is powered up */
    int64_t delay_ns; /* of the sync line's edges on the way to its pin, or through its comparator */
    double bandgap_v; /* it hears sync pulses on the data wire, by a comparator with this level; 0: on a wire of their own */
};

struct avr_node;

/* Returns NULL on failure, with the reason in `error`. */
struct avr_node *node_create(const struct node_plan *plan, const struct sync_line *sync,
                             char *error, size_t error_size);
void node_free(struct avr_node *node);

/* Runs to a time; edges of the sync line before it must have been announced. */
void node_run(struct avr_node *node, int64_t t_ns);

/* Sensors, each with a line of its own: 1 or 4. */
int node_sensors(const struct avr_node *node);
/* Sets the voltage at a sensor, counted from 0. */
void node_sense(struct avr_node *node, int sensor, double volts);
/* Number of edges of the sync line that it has seen, or that came before power-up. */
uint64_t node_seen(const struct avr_node *node);

/* Edges of a sensor's output pin, in order; the pin was at `before` until the first. */
size_t node_edges(const struct avr_node *node, int sensor, const struct pin_edge **edges, int8_t *before);
/* Forgets edges before a time. */
void node_forget(struct avr_node *node, int64_t t_ns);

/* Copies the beginning of its EEPROM, at most `size`; returns how much. */
size_t node_memory(struct avr_node *node, uint8_t *bytes, size_t size);
bool node_led(const struct avr_node *node);
void node_count(const struct avr_node *node, struct node_counters *counters);

#endif
