/* From a word and a code row to chips, one after the other.
 *
 * A chip costs a few shifts and decrements, as an interrupt asks for every one of them: nothing is
 * divided, multiplied or called. When the chips are due is for the caller to know; it is told where
 * guards lie.
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
    const uint8_t *row;        /* chips of a bit, least significant first, 1 for + */
    uint16_t order;            /* chips per bit */
    uint16_t slot_chips;       /* between guards; 0: there are none */
    bool negative;             /* sign of the row */
    uint8_t code_bits;         /* of a word */
    uint8_t parity;            /* 1: and one more bit, so that its ones are even */

    uint16_t word;             /* its bits from the present one on, that one on top */
    uint8_t bits_left;         /* with the present one */
    uint16_t chips_left;       /* of the present bit, with the present one */
    uint16_t slot_left;        /* of the sub-slot, with the present one */
    const uint8_t *octet;      /* of the row: the one after the present */
    uint8_t chips;             /* of the present octet, the present one lowest */
    uint8_t octet_left;        /* with the present one */
    bool inverted;             /* whether the row is sent as its negative now */
};

void sequencer_init(struct sequencer *s, const struct tp_node_record *record, const uint8_t *row);

/* Goes to the first chip of a word. code: its lowest bits count. */
void sequencer_start(struct sequencer *s, uint16_t code);

static inline void sequencer_begin_bit(struct sequencer *s)
{
    s->inverted = s->negative == !!(s->word & 0x8000u);
    s->octet = s->row;
    s->chips_left = s->order;
    s->octet_left = 8;
    s->chips = *s->octet++;
}

/* Whether the present chip is high. */
static inline bool sequencer_level(const struct sequencer *s)
{
    return (s->chips & 1u) != s->inverted;
}

/* Goes to the next chip, and tells what lies between. */
static inline enum sequencer_next sequencer_step(struct sequencer *s)
{
    if (--s->chips_left == 0) {
        if (--s->bits_left == 0)
            return SEQUENCER_END;
        s->word = (uint16_t)(s->word << 1);
        sequencer_begin_bit(s);
    } else if (--s->octet_left == 0) {
        s->octet_left = 8;
        s->chips = *s->octet++;
    } else {
        s->chips >>= 1;
    }
    /* without guards it starts at 0 and, as a frame has less than 65,536 chips, gets there no more */
    if (--s->slot_left == 0) {
        s->slot_left = s->slot_chips;
        return SEQUENCER_GUARD;
    }
    return SEQUENCER_CHIP;
}

#endif
