// SPDX-License-Identifier: Apache-2.0

/* The words of four sensors at once, on four lines of port D. All are at the same chip, so one write to the port sets all
 * four. The program works out the levels of a chip, waits for its cycle and writes them: edges have no jitter, and the four
 * none between them. A sub-slot is sent within the interrupt of its pulse, as entering one for every chip would take as
 * long as a chip; what main.c does for the next frame comes after it.
 *
 * sequencer.c would take too long for four. As there, chips are held in runs: up to 8 within one octet of the rows, one
 * bit and one sub-slot. The four are always at the same chip, and a scrambled frame flips them alike.
 */
#include "chips.h"

#include <avr/wdt.h>

#include "frame.h"
#include "node_board.h"
#include "scrambler.h"
#include "sequencer.h"

/* Shortest time in which a chip's levels can still be written at its cycle: 12 more than board_spin's, to choose them. */
#define WRITE_TICKS (BOARD_SPIN_TICKS + 12)
#define MOST_BITS 11u /* of a word, with parity */

static volatile bool paused;       /* the lines are released until a restart pulse */

static uint32_t chip_q16, lead_q16; /* ticks · 2¹⁶ */
static uint32_t start_q16;         /* (when the sub-slot begins + ½) · 2¹⁶ modulo 2³² */
static uint8_t levels;             /* on port D, of the next chip */
static uint8_t lines;              /* on port D, of those that speak */

/* What all frames are made by, and from minus on, this one. */
static const uint8_t *rows;        /* of the first sensor; those of the others follow, every BOARD_ROW octets */
static uint8_t heads[BOARD_SENSORS]; /* chips of their first octets, without what fills these up … */
static uint8_t unused;             /* … which are so many */
static uint8_t octets;             /* of a row */
static uint16_t slot_chips;        /* chips between guards; without guards more than a frame has */
static uint32_t scramble;          /* state of the scrambler before a frame; 0: none */
static uint8_t bits, parity;
static uint8_t negative;           /* rows with a negative sign: bit s */
static uint8_t minus[MOST_BITS];   /* rows that are inverted in a bit: bit s */

/* The present run. */
static uint8_t voice[BOARD_SENSORS]; /* chips of each, the present one in bit 0 */
static uint8_t left;               /* chips left, including the present one */
/* The next run, worked out in the last chip of the one before, so that no chip has to do all. */
static uint8_t between;            /* what comes before it (enum sequencer_next) */
static uint8_t run;                /* its chips, … */
static uint8_t octet_left;         /* … those left after it in its octet, … */
static uint16_t slot_left;         /* … and in its sub-slot */
static uint8_t octets_left, bits_left; /* including its own */
static const uint8_t *octet;       /* of the first row; NULL: heads … */
static bool is_new;                /* … unless it goes on in the octet of the one before */
static uint8_t flips, inverts;     /* of its octet, and of its bit: bit s */
static const uint8_t *next_inverts;
static uint8_t flips_ahead;        /* of the octet after it, if is_ahead */
static bool is_ahead;
static struct scrambler scrambler;

/* Unrolled, as an AVR shifts by a variable in a loop. */
#define EACH_VOICE(does) (does(0), does(1), does(2), does(3))

/* What flips the octet after the present one, worked out a chip before it is wanted, where there is one. */
static BOARD_INLINE void flip_ahead(void)
{
    if (!scramble || is_ahead)
        return;
    flips_ahead = scrambler_octet(&scrambler);
    is_ahead = true;
}

/* Goes to the next octet of a bit, or of the next bit. */
static BOARD_INLINE void begin_octet(void)
{
    flip_ahead();
    is_ahead = false;
    flips = flips_ahead;
    octet_left = 8;
    if (--octets_left) {
        octet = octets_left == octets - 1u ? rows + 1 : octet + 1;
        return;
    }
    bits_left--;
    octets_left = octets;
    octet = NULL;
    octet_left = (uint8_t)(8u - unused);
    flips = (uint8_t)(flips >> unused);
    inverts = *next_inverts++;
}

/* Works out the next run. */
static void next_run(void)
{
    between = SEQUENCER_CHIP;
    is_new = !octet_left;
    if (is_new)
        begin_octet();
    if (!bits_left) {
        between = SEQUENCER_END;
        return;
    }
    if (!slot_left) {
        between = SEQUENCER_GUARD;
        slot_left = slot_chips;
    }
    run = octet_left;
    if (slot_left < run)
        run = (uint8_t)slot_left;
    octet_left = (uint8_t)(octet_left - run);
    slot_left = (uint16_t)(slot_left - run);
}

/* Sets a voice's chips, the first of which is its level. */
static BOARD_INLINE void put(uint8_t s, uint8_t chips, uint8_t *high)
{
    voice[s] = chips;
    if (chips & 1u)
        *high = (uint8_t)(*high | 1u << (BOARD_FIRST_LINE + s));
}

/* Goes to the next chip; returns what lies between. */
static BOARD_INLINE uint8_t step(void)
{
    uint8_t lies = SEQUENCER_CHIP, high = 0;
    bool loads = false;

    if (--left == 0) {
        lies = between;
        left = run;
        loads = is_new;
    }
    if (!loads) {
#define SHIFT(s) put(s, voice[s] >> 1, &high)
        EACH_VOICE(SHIFT);
    } else {
        uint8_t opposite = (uint8_t)~flips;

#define LOAD(s) put(s, (uint8_t)(octet[s * BOARD_ROW] ^ (inverts & 1u << s ? opposite : flips)), &high)
#define HEAD(s) put(s, (uint8_t)(heads[s] ^ (inverts & 1u << s ? opposite : flips)), &high)
        if (octet)
            EACH_VOICE(LOAD);
        else
            EACH_VOICE(HEAD);
    }
    levels = high;
    if (left == 1)
        next_run();
    else if (left == 2)
        flip_ahead();
    return lies;
}

/* What the port is with these levels, and else as it is. */
static BOARD_INLINE uint8_t port_of(uint8_t high)
{
    return (uint8_t)((PORTD & ~BOARD_LINES) | (high & lines));
}

/* Sets the two registers, one after the other, so that the last one changes exactly at `at`. A line that is released while
 * it is high, or driven then, is pulled up for the cycle between. */
#define WRITE_PORT_AT(at, first, first_value, last, last_value)                                          \
    do {                                                                                           \
        uint8_t low = (uint8_t)(at);                                                               \
                                                                                                   \
        board_spin_most(at);                                                                       \
        __asm__ volatile(BOARD_SPIN_LAST                                                           \
                         "out %[one], %[one_value] \n\t"                                           \
                         "out %[other], %[other_value] \n\t"                                       \
                         : [left] "+d"(low)                                                        \
                         : [count] "n"(_SFR_MEM_ADDR(TCNT1L)), [one] "I"(_SFR_IO_ADDR(first)),      \
                           [one_value] "r"(first_value), [other] "I"(_SFR_IO_ADDR(last)),           \
                           [other_value] "r"(last_value));                                         \
    } while (0)

void chips_init(const struct tp_node_record *record, const uint8_t *row)
{
    rows = row;
    unused = frame_unused(record->order);
    octets = (uint8_t)((record->order + 7u) / 8u);
    negative = 0;
    for (uint8_t s = 0; s < BOARD_SENSORS; s++) {
        heads[s] = (uint8_t)(row[s * BOARD_ROW] >> unused);
        if (record[s].sign < 0)
            negative = (uint8_t)(negative | 1u << s);
    }
    slot_chips = record->resync_chips ? record->resync_chips : UINT16_MAX;
    scramble = record->scramble;
    bits = record->bits;
    parity = record->parity;
}

/* In which bits rows are inverted. */
static void plan_signs(const uint16_t *codes)
{
    uint16_t word[BOARD_SENSORS];

    for (uint8_t s = 0; s < BOARD_SENSORS; s++)
        word[s] = frame_word(codes[s], bits, parity);
    for (uint8_t bit = 0; bit < MOST_BITS; bit++) {
        uint8_t plus = 0;

#define SIGN(s) (word[s] & 0x8000u ? plus |= 1u << s : 0, word[s] = (uint16_t)(word[s] << 1))
        EACH_VOICE(SIGN);
        minus[bit] = (uint8_t)~(plus ^ negative);
    }
}

void chips_plan(const struct discipline *clock, const uint16_t *codes)
{
    plan_signs(codes);
    next_inverts = minus;
    scrambler_start(&scrambler, scramble);
    flips_ahead = 0;
    is_ahead = false;
    octet_left = 0;
    octets_left = 1;
    bits_left = (uint8_t)(frame_line_bits(bits, parity) + 1u);
    slot_left = slot_chips;
    next_run();
    left = 1;
    step();
    chip_q16 = clock->chip_q16;
    lead_q16 = clock->lead_q16;
}

void chips_choose(uint8_t sensors)
{
    lines = (uint8_t)(sensors << BOARD_FIRST_LINE);
}

struct chips_start chips_aim(uint32_t rise)
{
    start_q16 = (rise << 16) + lead_q16 + 0x8000u;
    return (struct chips_start){(uint16_t)(start_q16 >> 16)};
}

/* Sends the chips after a sub-slot's first one, which began at (edge_q16 - ½) / 2¹⁶; returns what comes after them. */
static BOARD_INLINE uint8_t send(uint32_t edge_q16)
{
    for (;;) {
        uint8_t lies = step(), now, high;
        uint16_t at;

        edge_q16 += chip_q16;
        at = (uint16_t)(edge_q16 >> 16);
        board_note_overflow();
        wdt_reset();
        if (lies != SEQUENCER_CHIP) {
            uint8_t ddr = (uint8_t)(DDRD & ~BOARD_LINES), none = port_of(0);

            at++;
            __asm__ volatile("" : "+r"(ddr), "+r"(none)); /* not after the wait */
            WRITE_PORT_AT(at, DDRD, ddr, PORTD, none);
            return lies;
        }
        now = PORTD;
        high = port_of(levels);
        __asm__ volatile("" : "+r"(now), "+r"(high));
        if (board_ticks_until(at) < WRITE_TICKS)
            return SEQUENCER_END; /* too late: silence is better than a wrong word */
        WRITE_PORT_AT(at, PORTD, now, PORTD, high);
    }
}

bool chips_begin(struct chips_start start)
{
    uint8_t high = port_of(levels), ddr = DDRD | lines;

    __asm__ volatile("" : "+r"(ddr), "+r"(high)); /* not after the wait */
    if (board_ticks_until(start.at) < WRITE_TICKS)
        return false;
    WRITE_PORT_AT(start.at, PORTD, high, DDRD, ddr);
    paused = send(start_q16) == SEQUENCER_GUARD;
    DDRD &= (uint8_t)~BOARD_LINES;
    PORTD &= (uint8_t)~BOARD_LINES;
    board_sync_on(); /* a restart's pulse may be due */
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
