// SPDX-License-Identifier: Apache-2.0

#include "talk.h"

#include <util/atomic.h>

#include "chips.h"
#include "node_board.h"
#include "sparse_code.h"
#include "sync_pulse.h"
#include "turn.h"

#define UNIT_TICKS (TP_SYNC_UNIT_US * BOARD_TICKS_PER_US)
/* For the end of a pulse a node waits until half a unit before the first chip, where it is no pulse of the
 * digitizer's any more. */
#define LONGEST_PULSE_TICKS ((TP_SYNC_LEAD - 1u) * UNIT_TICKS + UNIT_TICKS / 2u)

/* From the digit that asks all nodes to a frame's pulse, by an exact clock. Who tells turns scales it by its own;
 * else an eighth on either side will do, as no other digits come where such nodes are. */
#define ASKED_TICKS (6u * TP_SYNC_DIGIT * UNIT_TICKS)

static volatile uint8_t plan;      /* in which frames it transmits: */
#define TALKS (1u << TP_SYNC_FRAME) /* in an ordinary one … */
#define ANSWERS 0x80u              /* … and where it is asked to, or its number is announced */
/* … of several sensors: bit s and bit ANSWER + s, for sensor s, and whose words are in this frame */
#define ANSWER 4u
static uint8_t speaking;
#define EVERY ((sensor_set)((1u << BOARD_SENSORS) - 1u))

static uint32_t rise;              /* when the present pulse of the sync line began */
static bool high;                  /* whether the sync line is high */
static bool may_frame;             /* whether a frame pulse can come now */
static uint32_t earliest;          /* least ticks from a frame's pulse to the next */
static uint32_t slot_rise;         /* when the pulse of the present sub-slot began */
static uint32_t restart_earliest;  /* least ticks from there to the next restart … */
static uint32_t restart_width;     /* … and how much later it may be */
static uint16_t slot_places;       /* chips from one sub-slot to the next, guard included; 0: only one */
static uint8_t guard_chips;

static uint16_t node;              /* number of the first sensor */
static uint32_t due;               /* when the next frame's pulse is expected */
static uint16_t digit_ticks;       /* by this clock, from it back to the pulse of each digit of its turn */
static uint16_t turn;              /* its digits so far … */
static sensor_set others;          /* … for which it is another group's turn, or announces a number … */
static sensor_set asked;           /* … and which are to speak, with news or without */

static struct talk_frame frame;
volatile uint8_t talk_began, talk_pulsed;

/* The bit of a length in units, below 3: an AVR would shift in a loop. */
static BOARD_INLINE uint8_t bit_of(uint8_t units)
{
    uint8_t bit = units & 2u ? 4u : 1u;

    return units & 1u ? (uint8_t)(bit << 1) : bit;
}

/* Lengths of a pulse beginning now that this node answers: bit per length in units. */
static BOARD_INLINE uint8_t answers(void)
{
    if (chips_paused() && rise - slot_rise - restart_earliest <= restart_width)
        return 1u << TP_SYNC_RESTART;
    if (!may_frame)
        return 0;
    if (BOARD_SENSORS > 1) {
        speaking = (uint8_t)((plan >> ANSWER & asked) | (plan & EVERY & ~asked & ~others));
        return speaking ? TALKS : 0;
    }
    if (asked)
        return plan & ANSWERS ? TALKS : 0;
    return SPARSE_CODES && others ? 0 : plan & TALKS;
}

/* Takes in the digits so far. */
static BOARD_INLINE void take_turn(void)
{
    bool numbers = turn_has_number(turn);

    if (BOARD_SENSORS == 1) {
        others = numbers || turn_is_others(turn, node);
        asked = numbers ? turn_number(turn) == node : turn & TP_TURN_ASKED && !others;
        return;
    }
    uint8_t mine = 0, bit = 1, mask = turn_mask(turn), number = (uint8_t)node;
    uint16_t ahead = turn_number(turn) - node;

    for (; bit & EVERY; number++, bit = (uint8_t)(bit << 1))
        if (numbers ? ahead-- == 0 : !((number ^ (uint8_t)turn) & mask))
            mine |= bit;
    others = numbers ? EVERY : (uint8_t)(EVERY & ~mine);
    asked = numbers || turn & TP_TURN_ASKED ? mine : 0;
}

static BOARD_INLINE void pulse_ended(uint8_t units, bool spoke)
{
    high = false;
    if (BOARD_LARGE)
        talk_pulsed = 1;
    if (may_frame && units == TP_SYNC_FRAME) {
        frame.when = rise;
        frame.others = others;
        if (SPARSE_CODES)
            frame.turn = turn;
        frame.spoke = BOARD_SENSORS == 1 ? spoke : spoke ? speaking : 0;
        talk_began = 1;
        plan = 0;
    } else if (SPARSE_CODES && units == TP_SYNC_RESTART && !spoke) {
        turn |= turn_digit(due - rise, digit_ticks);
        take_turn();
    } else if (!SPARSE_CODES && units == TP_SYNC_RESTART && due - rise - ASKED_TICKS * 7u / 8u <= ASKED_TICKS / 4u) {
        asked = EVERY;
    }
}

/* From the end of a frame's pulse to the first chip it is 32 µs, of which another interrupt takes a part.
 * So a node that may have to transmit waits here for the pulse's end, with everything prepared. */
ISR(BOARD_SYNC_vect)
{
    uint32_t when;
    struct chips_start start;
    uint16_t length;
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
    start = chips_aim(rise);
    chips_hold(&start); /* not after the pulse */
    while (!over) {
        if (board_ticks_since((uint16_t)rise) >= LONGEST_PULSE_TICKS)
            return; /* too long; its falling edge will be an interrupt */
        over = board_sync_fell((uint16_t)rise, &length);
    }
    units = sync_pulse_units(length, UNIT_TICKS);
    if (ours & bit_of(units)) {
        if (BOARD_SENSORS > 1 && units == TP_SYNC_FRAME)
            chips_choose(speaking);
        spoke = chips_begin(start);
    }
    if (spoke)
        slot_rise = rise;
    else
        board_sync_on();
    pulse_ended(units, spoke);
}

void talk_init(const struct tp_node_record *record, const uint8_t *row)
{
    chips_init(record, row);
    frame.when = board_now() - 0x80000000u; /* long ago */
    node = record->node;
    guard_chips = record->guard_chips;
    slot_places = record->resync_chips ? record->resync_chips + guard_chips : 0;
    ATOMIC_BLOCK (ATOMIC_RESTORESTATE)
        board_sync_on();
}

void talk_expect(uint32_t when)
{
    ATOMIC_BLOCK (ATOMIC_RESTORESTATE) {
        due = when;
        asked = 0;
        if (SPARSE_CODES) {
            turn = 0;
            others = 0;
        }
    }
}

void talk_plan(const struct discipline *clock, const uint16_t *codes, sensor_set talks, sensor_set answers)
{
    uint32_t guard_ticks = guard_chips * (clock->chip_q16 >> 8) >> 8;
    uint32_t slot_ticks = 0;

    if (slot_places)
        slot_ticks = (uint32_t)((uint64_t)slot_places * clock->chip_q16 >> 16);
    chips_plan(clock, codes);
    /* a guard allows for clocks that are off by as much */
    if (SPARSE_CODES)
        digit_ticks = (uint16_t)(clock->lead_q16 * (TP_SYNC_DIGIT / TP_SYNC_LEAD) >> 16);
    restart_earliest = slot_ticks - guard_ticks;
    restart_width = 2u * guard_ticks;
    ATOMIC_BLOCK (ATOMIC_RESTORESTATE)
        earliest = discipline_earliest(clock);
    if (BOARD_SENSORS > 1)
        plan = (uint8_t)(talks | answers << ANSWER);
    else
        plan = (uint8_t)((talks ? TALKS : 0) | (answers ? ANSWERS : 0));
}

void talk_stop(void)
{
    ATOMIC_BLOCK (ATOMIC_RESTORESTATE) {
        plan = 0;
        chips_stop();
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
