#include "sequencer.h"

void sequencer_init(struct sequencer *s, const struct tp_node_record *record, const uint8_t *row)
{
    s->row = row;
    s->order = record->order;
    s->slot_chips = record->resync_chips;
    s->negative = record->sign < 0;
    s->code_bits = record->bits;
    s->parity = record->parity;
}

void sequencer_start(struct sequencer *s, uint16_t code)
{
    uint16_t word = (uint16_t)(code << (16u - s->code_bits));

    s->bits_left = frame_line_bits(s->code_bits, s->parity);
    if (s->parity) {
        uint8_t folded = (uint8_t)(word ^ word >> 8);

        folded ^= folded >> 4;
        folded ^= folded >> 2;
        folded ^= folded >> 1;
        word |= (uint16_t)((folded & 1u) << (16u - s->bits_left));
    }
    s->word = word;
    s->slot_left = s->slot_chips;
    sequencer_begin_bit(s);
}
