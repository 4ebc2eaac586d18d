// SPDX-License-Identifier: Apache-2.0

/* Chips by matches of a timer: an interrupt at every chip sets the timer for the next one, whose time
 * follows the sync pulses in fractions of a tick. */
#include "chips.h"

#include "node_board.h"
#include "sequencer.h"

/* The interrupt that ends a sub-slot comes this long before its end, because another interrupt may be
 * running and the next sub-slot is prepared in it. Chosen. */
#define RELEASE_LEAD_TICKS (46u * BOARD_TICKS_PER_US)
/* If the last chip is shorter than this, the interrupt at its beginning waits for its end: the release
 * lead above and the time of one more interrupt. Chosen. */
#define SHORT_CHIP_TICKS (60u * BOARD_TICKS_PER_US)

enum state {
    SILENT,    /* the line is released */
    TALKING,   /* a chip is on the line, and another follows */
    LAST,      /* the last chip of a sub-slot is on the line */
    PAUSED,    /* the line is released until a restart pulse */
};

static struct sequencer sequencer;
static volatile uint8_t state;

static uint32_t edge_q16;          /* (time of the last edge + ½) · 2¹⁶ modulo 2³² */
static uint32_t chip_q16, lead_q16;
static bool chips_are_short;

/* End of the chip planned last: its time, what follows (enum sequencer_next), and the level of that.
 * The timer is set to it when the chip begins. */
static uint16_t next_edge;
static uint8_t next;
static bool next_level;

static BOARD_INLINE void fall_silent(void)
{
    board_release();
    board_matches_off();
    state = SILENT;
    board_sync_on();
}

/* Goes to the next chip of the sequencer. */
static BOARD_INLINE void step(void)
{
    next = sequencer_step(&sequencer);
    next_level = sequencer_level(&sequencer);
}

static void end_slot(void)
{
    bool pauses = next == SEQUENCER_GUARD, level = sequencer_level(&sequencer);

    if (pauses)
        step(); /* now, because the restart's pulse may follow 16 µs after the slot */
    if (board_ticks_until(next_edge) >= BOARD_SPIN_TICKS)
        board_spin(next_edge);
    fall_silent();
    if (pauses) {
        state = PAUSED;
        board_latch(level);
    }
}

/* A sub-slot's last chip has begun, or its end is near. Not inlined: keeps the common path short. */
static __attribute__((noinline)) void last_chip(void)
{
    bool ends = state == LAST || chips_are_short;

    state = LAST;
    if (ends || !board_match(board_match_level(), (uint16_t)(next_edge - RELEASE_LEAD_TICKS)))
        end_slot();
}

/* A chip has begun: sets the timer for the next one first, then prepares the one after that. */
static BOARD_INLINE void chip_began(void)
{
    if (next != SEQUENCER_CHIP) {
        last_chip();
    } else if (board_match(next_level, next_edge)) {
        edge_q16 += chip_q16;
        next_edge = (uint16_t)(edge_q16 >> 16);
        step();
    } else {
        fall_silent(); /* too late: silence is better than a wrong word */
    }
}

ISR(BOARD_MATCH_vect)
{
    if (!board_match_is_last()) {
        if (!board_match_goes_on())
            fall_silent();
    } else if (state == TALKING) {
        chip_began();
    } else {
        last_chip();
    }
}

void chips_init(const struct tp_node_record *record, const uint8_t *row)
{
    sequencer_init(&sequencer, record, row);
}

void chips_plan(const struct discipline *clock, const uint16_t *codes)
{
    sequencer_start(&sequencer, *codes);
    chip_q16 = clock->chip_q16;
    chips_are_short = chip_q16 >> 16 < SHORT_CHIP_TICKS;
    lead_q16 = clock->lead_q16;
    board_latch(sequencer_level(&sequencer));
    step();
}

struct chips_start chips_aim(uint32_t rise)
{
    uint32_t start_q16 = (rise << 16) + lead_q16 + 0x8000u;
    uint16_t start = (uint16_t)(start_q16 >> 16);

    edge_q16 = start_q16 + chip_q16;
    next_edge = (uint16_t)(edge_q16 >> 16);
    board_match_past(start);
    return (struct chips_start){start};
}

bool chips_begin(struct chips_start start)
{
    if (board_ticks_until(start.at) < BOARD_SPIN_TICKS)
        return false;
    board_spin(start.at);
    board_drive();
    board_matches_on();
    board_sync_off();
    state = TALKING;
    chip_began();
    return true;
}

bool chips_paused(void)
{
    return state == PAUSED;
}

void chips_stop(void)
{
    /* if silent already, it listens: do not restart that, or the end of a present pulse is lost */
    if (state == TALKING || state == LAST)
        fall_silent();
    state = SILENT;
}
