// SPDX-License-Identifier: Apache-2.0

/* A sensing node. Once per frame, shortly before the next sync pulse, it reads the sensor and plans the
 * next frame; then it sleeps while the interrupts of talk.c transmit. */
#include <avr/interrupt.h>
#include <avr/wdt.h>

#include "node_board.h"
#include "discipline.h"
#include "event.h"
#include "number.h"
#include "talk.h"

#define MS (1000ul * BOARD_TICKS_PER_US)
/* Time from the start of the reading to the next pulse, µs: two conversions take 310 µs; the rest,
 * chosen, is for clock, plan and interrupts. */
#define MEASURING_US 800u
#define REST_READINGS 8 /* averaged to learn the code at rest. Chosen */

/* measuring_us: the reading, and 100 µs for the frame to end before it. */
static const struct node_limits limits = {.order = BOARD_ORDER,
                                          .chip_ns = BOARD_CHIP_NS,
                                          .scrambled_chip_ns = BOARD_SCRAMBLED_CHIP_NS,
                                          .sparse_chip_ns = BOARD_SPARSE_CHIP_NS,
                                          .longest_chip_ns = BOARD_LONGEST_CHIP_NS,
                                          .chip_step_ns = BOARD_CHIP_STEP_NS,
                                          .bits_restart = BOARD_BITS_RESTART,
                                          .measuring_us = 900,
                                          .restart_us = BOARD_RESTART_US};

static struct tp_node_record record;
static uint8_t row[BOARD_ORDER / 8 + 1]; /* chips_usart.c fetches an octet more than it sends */
static struct discipline clock;
static struct event event;

static uint32_t mark;      /* when the present frame's pulse began, or was due */
static bool heard;         /* … and whether it came */
static bool ever_heard;
static bool clock_known;   /* accurate enough to transmit */
static uint16_t code;      /* of the plan */

/* Frame periods in a row with pulses, but no frame's pulse at its time. */
static uint8_t strange;
#define STRANGE 32 /* of them the LED tells; chosen: half a second or so, more than a restarted digitizer takes */
#define PRESSED 16u /* 1/256 of the range: as far from rest a node takes a number. Chosen: a clear press */
#define BLINK 8u   /* frames that it is lit, and as many dark. Chosen: 0.1 s, unlike the faults above */

/* Waits until a frame begins (returns true) or a time comes. Feeds the watchdog while time advances. */
static bool wait(uint32_t until)
{
    uint32_t now = board_now(), fed = now - 1;

    while (!talk_began && (int32_t)(until - now) > 0) {
        if (now != fed)
            wdt_reset();
        fed = now;
        board_sleep(until, &talk_began);
        now = board_now();
    }
    return talk_began;
}

static uint16_t measured_code(void)
{
    return (uint16_t)(board_measure() >> (10u - record.bits));
}

static uint16_t learnt_rest(void)
{
    uint16_t sum = REST_READINGS / 2;

    for (uint8_t i = 0; i < REST_READINGS; i++) {
        sum = (uint16_t)(sum + measured_code());
        wait(board_now() + 8 * MS);
    }
    return sum / REST_READINGS;
}

/* Stays silent for ever and blinks the fault's number. */
static void blink(enum node_memory_fault fault)
{
    for (;;) {
        for (uint8_t i = 0; i < fault; i++) {
            board_led(true);
            wait(board_now() + 150 * MS);
            board_led(false);
            wait(board_now() + 350 * MS);
        }
        wait(board_now() + 1500 * MS);
    }
}

/* Blinks, without an end of its own, while pulses come that are none by this clock: it is another than the
 * record was made for, or the digitizer's frame period is. */
static void tell(bool sound)
{
    static uint8_t turns;

    if (!BOARD_LARGE)
        return;
    if (sound)
        strange = 0;
    else if (talk_pulsed && strange < STRANGE)
        strange++;
    talk_pulsed = 0;
    board_led(strange == STRANGE ? turns++ & BLINK : number_lacks());
}

static void plan(void)
{
    talk_stop();
    code = measured_code();
    bool ready = clock_known && !number_lacks();
    talk_plan(&clock, code, ready && event_talks(&event, code), ready);
}

static void begin(uint16_t rest)
{
    event_init(&event, &record, rest);
    discipline_init(&clock, &record, BOARD_TICKS_PER_US);
    clock_known = !record.discipline;
    talk_init(&record, row);
}

static void frame_began(void)
{
    struct talk_frame frame = talk_take();

    if (heard) {
        bool sound = discipline_period(&clock, frame.when - mark);
        clock_known |= sound;
        tell(sound);
    }
    mark = frame.when;
    heard = ever_heard = true;
    talk_expect(mark + clock.period);
    event_frame(&event, frame.others, frame.spoke, code);
    if (BOARD_LARGE && number_heard(frame.turn, event_farther(code, event.rest, PRESSED << record.bits >> 8), &record, row,
                     &limits))
        begin(event.rest);
}

/* No pulse came: counts the frame all the same, so that heartbeats keep their turns. */
static void frame_missed(void)
{
    mark += clock.period;
    heard = false;
    tell(false);
    talk_expect(mark + clock.period);
    if (ever_heard)
        event_frame(&event, false, false, code);
}

int main(void)
{
    enum node_memory_fault fault;

    board_init();
    sei();
    fault = number_load(&record, row, &limits);
    if (fault)
        blink(fault);

    begin(record.rest == TP_NODE_LEARN_REST ? learnt_rest() : record.rest);
    mark = board_now();
    for (;;) {
        plan();
        if (wait(mark + clock.period + clock.period / 2))
            frame_began();
        else
            frame_missed();
        /* an early pulse begins a frame, too, but this node has no plan for it and stays silent */
        while (wait(mark + clock.period - MEASURING_US * (uint32_t)BOARD_TICKS_PER_US))
            frame_began();
    }
}
