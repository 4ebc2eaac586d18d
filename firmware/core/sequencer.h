// SPDX-License-Identifier: Apache-2.0

/* Turns a word and a code into a sequence of chips.
 *
 * An interrupt steps through them, so they are held in runs: up to 8 chips within one octet of the
 * row, one bit and one sub-slot. A step within a run costs a shift and a decrement; a step to the
 * next run needs no division or multiplication. The caller times the chips; sequencer_step tells it
 * where guards lie.
 */
#ifndef TACTILE_SEQUENCER_H
#define TACTILE_SEQUENCER_H

#include <stdbool.h>
#include <stdint.h>

#include "frame.h"
#include "scrambler.h"
#include "sparse_code.h"
#include "tactile_protocol.h"

/* What follows a chip. */
enum sequencer_next {
    SEQUENCER_CHIP,    /* the next chip */
    SEQUENCER_GUARD,   /* a guard, then the next chip */
    SEQUENCER_END,     /* the word is over */
};

struct sequencer {
    const uint8_t *row;    /* chips of a bit, least significant first, 1 for +; ends with an octet */
    uint8_t head;          /* chips of its first octet, without what fills it up … */
    uint8_t unused;        /* … which are so many */
    bool is_sparse;        /* the row has the first octets of a sparse code */
    uint16_t order;        /* chips per bit */
    uint32_t scramble;     /* state of the scrambler before a word … */
    bool scrambles;        /* … which is not 0 */
    uint16_t slot_chips;   /* chips between guards; without guards more than a frame has */
    bool negative;         /* whether a 1 bit of the row's octets is -1 in a 1 bit of the word */
    uint8_t code_bits;     /* of a word, without parity */
    uint8_t parity;        /* 1: a further bit makes the number of ones even */

    uint8_t chips;         /* of the run, the present one in bit 0: 1 for high */
    uint8_t run_left;      /* chips left of the run, including the present one */
    uint8_t run;           /* chips of the run when it began, … */
    uint8_t octet_left;    /* … and chips then left of the octet, … */
    uint16_t bit_left;     /* … of the bit … */
    uint16_t slot_left;    /* … and of the sub-slot */
    const uint8_t *octet;  /* the row's next octet */
    struct scrambler flips;
    struct sparse_code sparse;
    uint8_t past[SPARSE_MOST_DIGITS];
    uint16_t word;         /* bits to send, the present one in bit 15 */
    uint8_t bits_left;     /* including the present one */
};

void sequencer_init(struct sequencer *s, const struct tp_node_record *record, const uint8_t *row);

/* Goes to the first chip of a word, the lowest code_bits of `code`. */
void sequencer_start(struct sequencer *s, uint16_t code);

/* Goes from a run's last chip to the next run. */
enum sequencer_next sequencer_turn(struct sequencer *s);

/* Whether the present chip is high. */
static inline bool sequencer_level(const struct sequencer *s)
{
    return s->chips & 1u;
}

/* Goes to the next chip; returns what lies between. */
static inline enum sequencer_next sequencer_step(struct sequencer *s)
{
    if (--s->run_left == 0)
        return sequencer_turn(s);
    s->chips >>= 1;
    return SEQUENCER_CHIP;
}

#endif
