// SPDX-License-Identifier: Apache-2.0

#include "talk.h"

#include <util/atomic.h>

#include "node_board.h"
#include "sequencer.h"
#include "sync_pulse.h"

#define UNIT_TICKS (TP_SYNC_UNIT_US * BOARD_TICKS_PER_US)
#define LONGEST_PULSE_TICKS (TP_SYNC_CALL * UNIT_TICKS + UNIT_TICKS / 2u)
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

static volatile uint8_t plan;      /* pulses that begin a transmission: bit per length in units */

static uint32_t rise;              /* when the present pulse of the sync line began */
static bool high;                  /* whether the sync line is high */
static bool may_frame;             /* whether a frame pulse can come now */
static uint32_t earliest;          /* least ticks from a frame's pulse to the next */
static uint32_t slot_rise;         /* when the pulse of the present sub-slot began */
static uint32_t restart_earliest;  /* least ticks from there to the next restart … */
static uint32_t restart_width;     /* … and how much later it may be */
static uint16_t slot_places;       /* chips from one sub-slot to the next, guard included; 0: only one */
static uint8_t guard_chips;

static struct talk_frame frame;
volatile uint8_t talk_began;

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

/* Sets the latch, while the line is released, to a sub-slot's first level. */
static void get_ready(void)
{
    board_latch(sequencer_level(&sequencer));
    step();
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
    if (!board_match_is_last())
        return;
    if (state == TALKING)
        chip_began();
    else
        last_chip();
}

/* Prepares the first chip after the present pulse; returns its time. */
static BOARD_INLINE uint16_t aim(void)
{
    uint32_t start_q16 = (rise << 16) + lead_q16 + 0x8000u;
    uint16_t start = (uint16_t)(start_q16 >> 16);

    edge_q16 = start_q16 + chip_q16;
    next_edge = (uint16_t)(edge_q16 >> 16);
    board_match_past(start);
    return start;
}

/* Begins a sub-slot at a time near ahead. False if it is too late for that. */
static BOARD_INLINE bool begin_slot(uint16_t start)
{
    if (board_ticks_until(start) < BOARD_SPIN_TICKS)
        return false;
    board_spin(start);
    board_drive();
    board_matches_on();
    board_sync_off();
    state = TALKING;
    slot_rise = rise;
    chip_began();
    return true;
}

/* Lengths of a pulse beginning now that this node answers: bit per length in units. */
static BOARD_INLINE uint8_t answers(void)
{
    if (state == PAUSED && rise - slot_rise - restart_earliest <= restart_width)
        return 1u << TP_SYNC_RESTART;
    return may_frame ? plan : 0;
}

static BOARD_INLINE void pulse_ended(uint8_t units, bool spoke)
{
    high = false;
    if (may_frame && (units == TP_SYNC_FRAME || units == TP_SYNC_CALL)) {
        frame.when = rise;
        frame.units = units;
        frame.spoke = spoke;
        talk_began = 1;
        plan = 0;
    }
}

/* From the end of a roll call's pulse to the first chip it is 16 µs, less than another interrupt takes.
 * So a node that may have to transmit waits here for the pulse's end, with everything prepared. */
ISR(BOARD_SYNC_vect)
{
    uint32_t when;
    uint16_t start, length;
    uint8_t ours, units;
    bool over, spoke = false;

    if (!board_sync_edge(&when)) {
        if (high)
            pulse_ended(sync_pulse_units(when - rise, UNIT_TICKS), false);
        return;
    }
    rise = when;
    high = true;
    may_frame = rise - frame.when >= earliest;
    ours = answers();
    over = board_sync_over((uint16_t)rise, ours == 1u << TP_SYNC_RESTART, &length);
    if (!over && !ours)
        return;
    start = aim();
    while (!over) {
        if (board_ticks_since((uint16_t)rise) >= LONGEST_PULSE_TICKS)
            return; /* too long; its falling edge will be an interrupt */
        over = board_sync_fell((uint16_t)rise, &length);
    }
    units = sync_pulse_units(length, UNIT_TICKS);
    if (ours & 1u << units)
        spoke = begin_slot(start);
    if (!spoke)
        board_sync_on();
    pulse_ended(units, spoke);
}

void talk_init(const struct tp_node_record *record, const uint8_t *row)
{
    sequencer_init(&sequencer, record, row);
    frame.when = board_now() - 0x80000000u; /* long ago */
    guard_chips = record->guard_chips;
    slot_places = record->resync_chips ? record->resync_chips + guard_chips : 0;
    ATOMIC_BLOCK (ATOMIC_RESTORESTATE)
        board_sync_on();
}

void talk_plan(const struct discipline *clock, uint16_t code, bool talks, bool talks_first)
{
    uint32_t guard_ticks = guard_chips * (clock->chip_q16 >> 8) >> 8;
    uint32_t slot_ticks = 0;

    if (slot_places)
        slot_ticks = (uint32_t)((uint64_t)slot_places * clock->chip_q16 >> 16);
    sequencer_start(&sequencer, code);
    chip_q16 = clock->chip_q16;
    chips_are_short = chip_q16 >> 16 < SHORT_CHIP_TICKS;
    lead_q16 = clock->lead_q16;
    /* a guard allows for clocks that are off by as much */
    restart_earliest = slot_ticks - guard_ticks;
    restart_width = 2u * guard_ticks;
    get_ready();
    ATOMIC_BLOCK (ATOMIC_RESTORESTATE)
        earliest = discipline_earliest(clock);
    plan = (uint8_t)(talks << TP_SYNC_FRAME | talks_first << TP_SYNC_CALL);
}

void talk_stop(void)
{
    ATOMIC_BLOCK (ATOMIC_RESTORESTATE) {
        plan = 0;
        /* if silent already, it listens: do not restart that, or the end of a present pulse is lost */
        if (state == TALKING || state == LAST)
            fall_silent();
        state = SILENT;
    }
}

struct talk_frame talk_take(void)
{
    struct talk_frame taken;

    ATOMIC_BLOCK (ATOMIC_RESTORESTATE) {
        taken = frame;
        talk_began = 0;
    }
    return taken;
}
