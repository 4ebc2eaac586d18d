// SPDX-License-Identifier: Apache-2.0

/* From a word and a code row to chips, one after the other.
 *
 * An interrupt asks for every chip, so they come in runs: up to 8 chips of the row that lie in one
 * octet, one bit and one sub-slot. Within a run a chip costs a shift and a decrement; between runs
 * nothing is divided or multiplied, either. When the chips are due is for the caller to know; it is
 * told where guards lie.
 */
#ifndef TACTILE_SEQUENCER_H
#define TACTILE_SEQUENCER_H

#include <stdbool.h>
#include <stdint.h>

#include "frame.h"
#include "tactile_protocol.h"

/* What follows a chip. */
enum sequencer_next {
    SEQUENCER_CHIP,    /* the next one */
    SEQUENCER_GUARD,   /* a guard; after it the next one */
    SEQUENCER_END,     /* nothing: the word is over */
};

struct sequencer {
    const uint8_t *row;    /* chips of a bit, least significant first, 1 for + */
    uint16_t order;        /* chips per bit */
    uint16_t slot_chips;   /* between guards; more than a frame has, where there are none */
    bool negative;         /* sign of the row */
    uint8_t code_bits;     /* of a word */
    uint8_t parity;        /* 1: and one more bit, so that its ones are even */

    uint8_t chips;         /* of the run, the present one lowest: 1 for high */
    uint8_t run_left;      /* chips of the run, with the present one */
    uint8_t run;           /* … and when it began */
    uint8_t octet_left;    /* so many were left of the octet then, … */
    uint16_t bit_left;     /* … of the bit … */
    uint16_t slot_left;    /* … and of the sub-slot */
    const uint8_t *octet;  /* of the row: the next one */
    uint16_t word;         /* bits to be sent, the present one on top */
    uint8_t bits_left;     /* with the present one */
};

void sequencer_init(struct sequencer *s, const struct tp_node_record *record, const uint8_t *row);

/* Goes to the first chip of a word. code: its lowest bits count. */
void sequencer_start(struct sequencer *s, uint16_t code);

/* From a run's last chip to the next run. */
enum sequencer_next sequencer_turn(struct sequencer *s);

/* Whether the present chip is high. */
static inline bool sequencer_level(const struct sequencer *s)
{
    return s->chips & 1u;
}

/* Goes to the next chip, and tells what lies between. */
static inline enum sequencer_next sequencer_step(struct sequencer *s)
{
    if (--s->run_left == 0)
        return sequencer_turn(s);
    s->chips >>= 1;
    return SEQUENCER_CHIP;
}

#endif
