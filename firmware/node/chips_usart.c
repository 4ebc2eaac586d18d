// SPDX-License-Identifier: Apache-2.0

/* Chips by the ATmega328P's USART as master of a serial bus: its shift register is double-buffered, so
 * chips follow each other without a gap or jitter, whatever the program does. TXD (PD1) is the line;
 * XCK (PD4) shows the chips' clock and stays unconnected.
 *
 * A chip is 2·(UBRR0 + 1) cycles, by the node's own clock: only the beginning of a sub-slot follows the
 * sync line, so a sub-slot is one bit.
 *
 * An enabled transmitter drives the line, high until its first octet. So it begins with chips that nobody
 * uses, as short as they can be, 2 cycles each: the guard, an octet of the code, so that nodes do not
 * add up; and where a bit does not fill its first octet, the rest of that. During the last of these
 * UBRR0 is written, which restarts the clock's divider and so times the first chip to the cycle.
 */
#include "chips.h"

#include "frame.h"
#include "node_board.h"
#include "scrambler.h"
#include "sparse_code.h"

#define CHIP_STEP_CYCLES 2u
#define STEPS_PER_US (BOARD_TICKS_PER_US / CHIP_STEP_CYCLES)
/* Cycles from the end of board_spin to the first chip, without UBRR0 and the octet's unused chips. Counted
 * in the instructions of chips_begin; of the data sheet's silence it assumes that an idle transmitter takes an
 * octet at the next clock of its divider, and that two of these make a chip. Measure it on an
 * oscilloscope (docs/firmware.md): an error is common to all nodes. */
#define START_CYCLES 21u

static const uint8_t *row;
static uint8_t row_0, row_1, last_octet; /* the first two are 0 of a sparse code */
static uint16_t more;   /* octets of a bit, but for the first */
static struct sparse_code sparse; /* whose first octets the row has, if it is of one */
static uint8_t past[SPARSE_MOST_DIGITS];
enum { PLAIN, FLIPPED, SPARSE };
static uint8_t kind;    /* of the code: one of these */
static uint8_t unused;  /* of the first octet's chips; even, as node_memory.c takes no odd orders */
static uint8_t divider; /* UBRR0 */
static bool negative;
static uint8_t bits, parity;

static uint16_t lead;      /* ticks from a pulse to when chips_begin has to begin */
static uint16_t word;      /* bits to send, the next one in bit 15; of a code of opposite sign inverted */
static uint8_t bits_left;
static volatile bool paused;

static uint32_t scramble;     /* state of the scrambler before a word */
static struct scrambler scrambler;
/* The next two octets, of a row what flips them; there is no time for that between pulse and bit. */
static uint8_t ahead[2];

static uint8_t flip;          /* of the bit: 0xFF inverts the row's chips */
static uint8_t wait;          /* turns of 4 cycles between the first two and UBRR0 */

void chips_init(const struct tp_node_record *record, const uint8_t *chips)
{
    row = chips;
    more = (record->order + 7u) / 8u - 1u;
    unused = frame_unused(record->order);
    scramble = record->scramble;
    kind = record->digits ? SPARSE : scramble ? FLIPPED : PLAIN;
    row_0 = kind == SPARSE ? 0 : chips[0];
    row_1 = kind == SPARSE ? 0 : chips[1];
    last_octet = chips[kind == SPARSE ? record->digits - 1u : more];
    if (kind == SPARSE)
        sparse_init(&sparse, record->digits);
    wait = (uint8_t)(3u + unused / 2u);
    divider = (uint8_t)(record->chip_ns * STEPS_PER_US / 1000u - 1u);
    negative = (record->sign < 0) != (kind == SPARSE); /* of whose octets a 1 is -1 */
    bits = record->bits;
    parity = record->parity;
    UCSR0C = _BV(UMSEL01) | _BV(UMSEL00) | _BV(UDORD0); /* master; least significant chip first */
}

/* What comes after those ahead. */
static uint8_t next_ahead(void)
{
    uint8_t flips = kind == PLAIN ? 0 : scrambler_octet(&scrambler);

    return kind == SPARSE ? flips ^ sparse_octet(&sparse, past) : flips;
}

void chips_plan(const struct discipline *clock, const uint16_t *codes)
{
    word = frame_word(*codes, bits, parity);
    if (negative)
        word = ~word;
    bits_left = frame_line_bits(bits, parity);
    lead = (uint16_t)((clock->lead_q16 + 0x8000u) >> 16) -
           (START_CYCLES + CHIP_STEP_CYCLES * unused + divider);
    scrambler_start(&scrambler, scramble);
    if (kind == SPARSE)
        sparse_start(&sparse, past, row);
    ahead[0] = next_ahead();
    ahead[1] = next_ahead();
}

struct chips_start chips_aim(uint32_t rise)
{
    struct chips_start start = {.at = (uint16_t)rise + lead, .more = more, .divider = divider, .wait = wait};

    flip = word & 0x8000u ? 0 : 0xFF;
    start.guard = last_octet ^ flip;
    start.first = flip ^ ahead[0] ^ row_0;
    start.second = flip ^ ahead[1] ^ row_1; /* of a bit of one octet nobody sends it */
    return start;
}

/* While the last chips are in the transmitter, which releases the line after them. */
static BOARD_INLINE void end_bit(void)
{
    UCSR0B = 0;
    word = (uint16_t)(word << 1);
    paused = --bits_left;
    board_sync_on(); /* a restart's pulse may be due */
}

static BOARD_INLINE void send(uint8_t chips)
{
    while (!(UCSR0A & _BV(UDRE0)))
        ;
    UDR0 = chips;
}

/* Sends the `left` - 1 other octets of a bit whose first two are under way. */
static BOARD_INLINE void send_row(uint16_t left)
{
    const uint8_t *octet = row + 2;
    uint8_t mask = flip;
    bool flipping = kind == FLIPPED;

    for (; left > 1; left--) {
        uint8_t chips = *octet++ ^ mask;
        if (flipping)
            chips ^= scrambler_octet(&scrambler);
        board_note_overflow();
        send(chips);
    }
    end_bit();
    if (flipping) {
        ahead[0] = left ? scrambler_octet(&scrambler) : ahead[1];
        ahead[1] = scrambler_octet(&scrambler);
    }
}

/* Sends those of a sparse code. What makes its octets is in registers, so that one takes some 100 cycles of the
 * 128 that there are. */
static BOARD_INLINE void send_sparse(uint16_t left)
{
    struct sparse_code code = sparse;
    struct scrambler flips = scrambler;
    uint8_t mask = flip;

    for (; left > 1; left--) {
        uint8_t chips = sparse_octet(&code, past) ^ scrambler_octet(&flips) ^ mask;
        board_note_overflow();
        send(chips);
    }
    end_bit();
    ahead[0] = left ? sparse_octet(&code, past) ^ scrambler_octet(&flips) : ahead[1];
    ahead[1] = sparse_octet(&code, past) ^ scrambler_octet(&flips);
    sparse = code;
    scrambler = flips;
}

/* Returns while the last chips are in the transmitter. */
__attribute__((flatten)) /* a call takes 8 cycles, and keeps nothing in registers */
bool chips_begin(struct chips_start start)
{
    uint8_t on = _BV(TXEN0), turns = start.wait, until = (uint8_t)start.at;
    int16_t ticks;

    /* Nothing is left to be loaded from here on; nor after UBRR0, as the next octet may be due 17 cycles
     * later. */
    __asm__ volatile("" : "+r"(on), "+r"(turns));
    ticks = board_ticks_until(start.at);
    if (ticks < BOARD_SPIN_LEAST)
        return false;
    if (ticks > 4 * BOARD_SPIN_TICKS)
        board_spin_most(start.at);
    __asm__ volatile(BOARD_SPIN_LAST
                     "sts %[clock], __zero_reg__ \n\t" /* not before: the last bit's chips need theirs */
                     "sts %[control], %[on]   \n\t"
                     "sts %[data], %[octet_0] \n\t"
                     "sts %[data], %[octet_1] \n\t"
                     "5: nop                  \n\t" /* 4 cycles each, 3 the last time */
                     "dec %[turns]            \n\t"
                     "brne 5b                 \n\t"
                     "nop                     \n\t"
                     "sts %[clock], %[rate]   \n\t"
                     : [left] "+d"(until), [turns] "+r"(turns)
                     : [on] "r"(on), [octet_0] "r"(start.guard), [octet_1] "r"(start.first),
                       [rate] "r"(start.divider), [control] "n"(_SFR_MEM_ADDR(UCSR0B)),
                       [data] "n"(_SFR_MEM_ADDR(UDR0)), [clock] "n"(_SFR_MEM_ADDR(UBRR0L)),
                       [count] "n"(_SFR_MEM_ADDR(TCNT1L)));
    if (start.more)
        send(start.second);
    if (kind == SPARSE)
        send_sparse(start.more);
    else
        send_row(start.more);
    return true;
}

bool chips_paused(void)
{
    return paused;
}

void chips_stop(void)
{
    paused = false;
}
