// SPDX-License-Identifier: Apache-2.0

/* Chips by the ATmega328P's USART as master of a serial bus: its shift register is double-buffered, so
 * chips follow each other without a gap or jitter, whatever the program does. TXD (PD1) is the line;
 * XCK (PD4) shows the chips' clock and stays unconnected.
 *
 * A chip is 2·(UBRR0 + 1) cycles, by the node's own clock: only the beginning of a sub-slot follows the
 * sync line, so a sub-slot is one bit.
 *
 * An enabled transmitter drives the line, high until its first octet. So it begins with chips that nobody
 * uses, as short as they can be, 2 cycles each: the guard, an octet of the row, so that nodes do not
 * add up; and where the row does not fill its first octet, the rest of that. During the last of these
 * UBRR0 is written, which restarts the clock's divider and so times the first chip to the cycle.
 */
#include "chips.h"

#include "frame.h"
#include "node_board.h"
#include "scrambler.h"

#define CHIP_STEP_CYCLES 2u
#define STEPS_PER_US (BOARD_TICKS_PER_US / CHIP_STEP_CYCLES)
/* Cycles from the end of board_spin to the first chip, without UBRR0 and the octet's unused chips. Counted
 * in the instructions of chips_begin; of the data sheet's silence it assumes that an idle transmitter takes an
 * octet at the next clock of its divider, and that two of these make a chip. Measure it on an
 * oscilloscope (docs/firmware.md): an error is common to all nodes. */
#define START_CYCLES 21u

static const uint8_t *row, *row_end;
static uint8_t unused;  /* of the first octet's chips; even, as node_memory.c takes no odd orders */
static uint8_t divider; /* UBRR0 */
static bool negative;
static uint8_t bits, parity;

static uint32_t lead_q16;
static uint16_t word;      /* bits to send, the next one in bit 15 */
static uint8_t bits_left;
static volatile bool paused;

static uint32_t scramble;     /* state of the scrambler before a word … */
static bool scrambles;        /* … which is not 0 */
static struct scrambler scrambler;
static uint8_t flips[2];      /* of the next two octets; there is no time for them between pulse and bit */

static uint8_t flip;          /* of the bit: 0xFF inverts the row's chips */
static uint8_t guard, first, second; /* octets to begin with */
static uint8_t wait;          /* turns of 4 cycles between the first two and UBRR0 */

void chips_init(const struct tp_node_record *record, const uint8_t *chips)
{
    row = chips;
    row_end = chips + (record->order + 7u) / 8u;
    unused = frame_unused(record->order);
    scramble = record->scramble;
    scrambles = scramble != 0;
    divider = (uint8_t)(record->chip_ns * STEPS_PER_US / 1000u - 1u);
    negative = record->sign < 0;
    bits = record->bits;
    parity = record->parity;
    UCSR0C = _BV(UMSEL01) | _BV(UMSEL00) | _BV(UDORD0); /* master; least significant chip first */
}

void chips_plan(const struct discipline *clock, uint16_t code)
{
    word = frame_word(code, bits, parity);
    bits_left = frame_line_bits(bits, parity);
    lead_q16 = clock->lead_q16;
    scrambler_start(&scrambler, scramble);
    flips[0] = scrambler_octet(&scrambler);
    flips[1] = scrambler_octet(&scrambler);
}

uint16_t chips_aim(uint32_t rise)
{
    uint16_t start = (uint16_t)(((rise << 16) + lead_q16 + 0x8000u) >> 16);

    flip = negative == !!(word & 0x8000u) ? 0xFF : 0;
    guard = row_end[-1] ^ flip;
    first = row[0] ^ flip ^ flips[0];
    second = row[1] ^ flip ^ flips[1]; /* of a row of one octet nobody sends it */
    wait = (uint8_t)(3u + unused / 2u);
    return start - START_CYCLES - CHIP_STEP_CYCLES * unused - divider;
}

/* Returns while the last chips are in the transmitter, which releases the line after them. */
bool chips_begin(uint16_t at)
{
    const uint8_t *octet = row + 2, *end = row_end;
    uint8_t on = _BV(TXEN0), octet_0 = guard, octet_1 = first, rate = divider, turns = wait;
    uint8_t mask = flip, chips = second;
    bool flipping = scrambles;

    if (board_ticks_until(at) < BOARD_SPIN_TICKS)
        return false;
    /* Nothing is left to be loaded between board_spin and the cycle that it waits for; nor after UBRR0,
     * as the next octet may be due 17 cycles later. */
    __asm__ volatile("" : "+r"(on), "+r"(octet_0), "+r"(octet_1), "+r"(rate), "+r"(turns),
                          "+r"(octet), "+r"(end), "+r"(mask), "+r"(chips), "+r"(flipping));
    board_spin(at);
    __asm__ volatile("sts %[clock], __zero_reg__ \n\t" /* not before: the last bit's chips need theirs */
                     "sts %[control], %[on]   \n\t"
                     "sts %[data], %[octet_0] \n\t"
                     "sts %[data], %[octet_1] \n\t"
                     "1: nop                  \n\t" /* 4 cycles each, 3 the last time */
                     "dec %[turns]            \n\t"
                     "brne 1b                 \n\t"
                     "nop                     \n\t"
                     "sts %[clock], %[rate]   \n\t"
                     : [turns] "+r"(turns)
                     : [on] "r"(on), [octet_0] "r"(octet_0), [octet_1] "r"(octet_1),
                       [rate] "r"(rate), [control] "n"(_SFR_MEM_ADDR(UCSR0B)),
                       [data] "n"(_SFR_MEM_ADDR(UDR0)), [clock] "n"(_SFR_MEM_ADDR(UBRR0L)));
    while (octet <= end) {
        while (!(UCSR0A & _BV(UDRE0)))
            ;
        UDR0 = chips;
        chips = *octet++ ^ mask;
        if (flipping)
            chips ^= flips[1] = scrambler_octet(&scrambler);
        board_note_overflow();
    }
    UCSR0B = 0;
    word = (uint16_t)(word << 1);
    paused = --bits_left;
    board_sync_on(); /* a restart's pulse may be due */
    if (flipping) {
        flips[0] = flips[1]; /* that of an octet that was not sent */
        flips[1] = scrambler_octet(&scrambler);
    }
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
