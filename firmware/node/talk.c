#include "talk.h"

#include <util/atomic.h>

#include "board.h"
#include "sequencer.h"
#include "sync_pulse.h"

#define UNIT_TICKS (TP_SYNC_UNIT_US * BOARD_TICKS_PER_US)
#define LONGEST_PULSE_TICKS (TP_SYNC_CALL * UNIT_TICKS + UNIT_TICKS / 2u)
/* The interrupt that ends a sub-slot comes so long before its end: others may be running. */
#define RELEASE_LEAD_TICKS (30u * BOARD_TICKS_PER_US)
/* A last chip shorter than this is waited for by the interrupt that began it. */
#define SHORT_CHIP_TICKS (60u * BOARD_TICKS_PER_US)

enum state {
    SILENT,    /* the line is released */
    TALKING,   /* chips follow each other */
    LAST,      /* a sub-slot's last chip is on the line */
    PAUSED,    /* the line is released until a restart pulse */
};

static struct sequencer sequencer;
static volatile uint8_t state;
static bool more;                  /* LAST: another sub-slot follows */

static uint32_t edge_q16;          /* time of the last edge, of its 32 bits the 16 lowest, · 2¹⁶ */
static uint32_t chip_q16, lead_q16;

static volatile bool planned;
static bool plan_talks, plan_talks_first;

static uint32_t rise;              /* when the sync line's present pulse began */
static bool high;                  /* whether there is one */
static bool may_frame, may_restart;  /* what it may be, by the time of its beginning */
static uint32_t earliest;          /* ticks from a frame's pulse to the next one's, at least */
static uint32_t slot_rise;         /* when the pulse of the present sub-slot began */
static uint32_t restart_earliest;  /* ticks from there to the next one's, at least … */
static uint32_t restart_width;     /* … and how much later it may be */
static uint16_t slot_places;       /* chips from a sub-slot to the next; 0: there is only one */
static uint8_t guard_chips;

static struct talk_frame frame;
volatile uint8_t talk_began;

static BOARD_INLINE uint16_t ticks(uint32_t q16)
{
    return (uint16_t)((q16 + 0x8000u) >> 16);
}

static BOARD_INLINE void fall_silent(void)
{
    board_release();
    board_matches_off();
    state = SILENT;
    board_sync_on();
}

/* The last chip ends at edge_q16. */
static BOARD_INLINE void end_slot(void)
{
    uint16_t end = ticks(edge_q16);

    if (board_ticks_until(end) >= BOARD_SPIN_TICKS)
        board_spin(end);
    fall_silent();
    if (more) {
        state = PAUSED;
        board_latch(sequencer_level(&sequencer));
    }
}

/* A chip has begun, at edge_q16; says whether it is one to be waited for. */
static BOARD_INLINE bool chip_began(void)
{
    uint16_t here = ticks(edge_q16), end;
    enum sequencer_next next = sequencer_step(&sequencer);
    bool level, in_time;

    edge_q16 += chip_q16;
    end = ticks(edge_q16);
    if (next == SEQUENCER_CHIP) {
        level = sequencer_level(&sequencer);
    } else {
        state = LAST;
        more = next == SEQUENCER_GUARD;
        if ((uint16_t)(end - here) < SHORT_CHIP_TICKS)
            return true;
        level = board_match_level();
        end -= RELEASE_LEAD_TICKS;
    }
    in_time = board_match(level, here, end);
    if (!in_time)
        fall_silent(); /* rather than say something else */
    return false;
}

/* One for both interrupts: a copy in each would take a quarter of the ATtiny85's memory. */
static __attribute__((noinline)) void advance(void)
{
    if (state == LAST || chip_began())
        end_slot();
}

ISR(BOARD_MATCH_vect)
{
    if (board_match_is_last())
        advance();
}

/* The present pulse was one for us: the first chip comes `lead` after its beginning. */
static BOARD_INLINE bool begin_slot(void)
{
    uint32_t start_q16 = (rise << 16) + lead_q16;
    uint16_t start = ticks(start_q16);

    if (board_ticks_until(start) < BOARD_SPIN_TICKS) {
        state = SILENT;
        return false;
    }
    board_sync_off();
    board_match_past(start);
    board_spin(start);
    board_drive();
    board_matches_on();
    state = TALKING;
    slot_rise = rise;
    edge_q16 = start_q16;
    advance();
    return true;
}

static BOARD_INLINE void pulse_ends(uint32_t when)
{
    uint8_t units = sync_pulse_units(when - rise, UNIT_TICKS);
    bool speaks = false;

    high = false;
    if (units == TP_SYNC_RESTART) {
        speaks = may_restart;
    } else if (units != SYNC_PULSE_GLITCH && may_frame) {
        speaks = planned && (units == TP_SYNC_CALL ? plan_talks_first : plan_talks);
        planned = false;
        frame.when = rise;
        frame.units = units;
        frame.spoke = speaks;
        talk_began = 1;
    }
    if (speaks && !begin_slot())
        frame.spoke = false;
}

static BOARD_INLINE void pulse_begins(uint32_t when)
{
    rise = when;
    high = true;
    may_frame = when - frame.when >= earliest;
    may_restart = state == PAUSED &&
                  when - slot_rise - restart_earliest <= restart_width;
}

/* After a roll call's pulse there are 16 µs to the first chip, less than another interrupt would take:
 * who might have to speak waits for the pulse's end here. */
ISR(BOARD_SYNC_vect)
{
    uint32_t when;

    if (board_sync_edge(&when)) {
        pulse_begins(when);
        if (!may_restart && !(may_frame && planned && (plan_talks || plan_talks_first)))
            return;
        while (!board_sync_pending())
            if (board_ticks_since((uint16_t)when) >= LONGEST_PULSE_TICKS)
                return;
        board_sync_edge(&when);
    }
    if (high)
        pulse_ends(when);
}

void talk_init(const struct tp_node_record *record, const uint8_t *row)
{
    sequencer_init(&sequencer, record, row);
    guard_chips = record->guard_chips;
    slot_places = record->resync_chips ? record->resync_chips + guard_chips : 0;
    ATOMIC_BLOCK (ATOMIC_RESTORESTATE)
        board_sync_on();
}

void talk_plan(const struct discipline *clock, uint16_t code, bool talks, bool talks_first)
{
    uint32_t guard_ticks = guard_chips * (clock->chip_q16 >> 8) >> 8;
    uint32_t slot_ticks = (uint32_t)((uint64_t)slot_places * clock->chip_q16 >> 16);

    sequencer_start(&sequencer, code);
    chip_q16 = clock->chip_q16;
    lead_q16 = clock->lead_q16;
    /* what a guard is there for is clocks that are off by as much */
    restart_earliest = slot_ticks - guard_ticks;
    restart_width = 2u * guard_ticks;
    plan_talks = talks;
    plan_talks_first = talks_first;
    board_latch(sequencer_level(&sequencer));
    planned = true;
}

void talk_stop(void)
{
    ATOMIC_BLOCK (ATOMIC_RESTORESTATE) {
        planned = false;
        fall_silent();
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

void talk_believe(uint32_t ticks_after)
{
    ATOMIC_BLOCK (ATOMIC_RESTORESTATE)
        earliest = ticks_after;
}
