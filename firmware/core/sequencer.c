// SPDX-License-Identifier: Apache-2.0

#include "sequencer.h"

void sequencer_init(struct sequencer *s, const struct tp_node_record *record, const uint8_t *row)
{
    s->row = row;
    s->unused = frame_unused(record->order);
    s->head = (uint8_t)(*row >> s->unused);
    s->is_sparse = SPARSE_CODES && record->digits;
    if (SPARSE_CODES && s->is_sparse)
        sparse_init(&s->sparse, record->digits);
    s->order = record->order;
    s->scramble = record->scramble;
    s->scrambles = record->scramble != 0;
    /* a frame has at most 11 · 4096 = 45,056 chips, fewer than UINT16_MAX */
    s->slot_chips = record->resync_chips ? record->resync_chips : UINT16_MAX;
    s->negative = (record->sign < 0) != s->is_sparse;
    s->code_bits = record->bits;
    s->parity = record->parity;
}

/* Loads chips of the code; unused: chips of their octet that are not among them. */
static void load(struct sequencer *s, uint8_t octet, uint8_t unused)
{
    bool inverted = s->negative == !!(s->word & 0x8000u);

    s->chips = inverted ? (uint8_t)~octet : octet;
    if (s->scrambles)
        s->chips ^= (uint8_t)(scrambler_octet(&s->flips) >> unused);
    s->octet_left = (uint8_t)(8u - unused);
}

static void begin_bit(struct sequencer *s)
{
    s->bit_left = s->order;
    if (SPARSE_CODES && s->is_sparse) {
        load(s, (uint8_t)(sparse_octet(&s->sparse, s->past) >> s->unused), s->unused);
        return;
    }
    s->octet = s->row + 1;
    load(s, s->head, s->unused);
}

static void begin_run(struct sequencer *s)
{
    uint8_t run = s->octet_left;

    if (s->bit_left < run)
        run = (uint8_t)s->bit_left;
    if (s->slot_left < run)
        run = (uint8_t)s->slot_left;
    s->run = s->run_left = run;
}

void sequencer_start(struct sequencer *s, uint16_t code)
{
    s->bits_left = frame_line_bits(s->code_bits, s->parity);
    s->word = frame_word(code, s->code_bits, s->parity);
    s->slot_left = s->slot_chips;
    scrambler_start(&s->flips, s->scramble);
    if (SPARSE_CODES && s->is_sparse)
        sparse_start(&s->sparse, s->past, s->row);
    begin_bit(s);
    begin_run(s);
}

enum sequencer_next sequencer_turn(struct sequencer *s)
{
    enum sequencer_next next = SEQUENCER_CHIP;

    s->octet_left = (uint8_t)(s->octet_left - s->run);
    s->bit_left = (uint16_t)(s->bit_left - s->run);
    s->slot_left = (uint16_t)(s->slot_left - s->run);
    if (s->bit_left == 0) {
        if (--s->bits_left == 0)
            return SEQUENCER_END;
        s->word = (uint16_t)(s->word << 1);
        begin_bit(s);
    } else if (s->octet_left == 0) {
        load(s, SPARSE_CODES && s->is_sparse ? sparse_octet(&s->sparse, s->past) : *s->octet++, 0);
    } else {
        s->chips >>= 1;
    }
    if (s->slot_left == 0) {
        s->slot_left = s->slot_chips;
        next = SEQUENCER_GUARD;
    }
    begin_run(s);
    return next;
}
