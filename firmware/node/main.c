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
#define REST_READINGS 8 /* averaged to learn the code at rest. Chosen */

static const struct node_limits limits = {.order = BOARD_ORDER,
                                          .chip_ns = BOARD_CHIP_NS,
                                          .scrambled_chip_ns = BOARD_SCRAMBLED_CHIP_NS,
                                          .sparse_chip_ns = BOARD_SPARSE_CHIP_NS,
                                          .longest_chip_ns = BOARD_LONGEST_CHIP_NS,
                                          .chip_step_ns = BOARD_CHIP_STEP_NS,
                                          .bits_restart = BOARD_BITS_RESTART,
                                          .measuring_us = BOARD_MEASURING_US,
                                          .restart_us = BOARD_RESTART_US,
                                          .hears_own = BOARD_HEARS_OWN,
                                          .hears_data = BOARD_HEARS_DATA};

static struct tp_node_record record[BOARD_SENSORS];
static uint8_t row[BOARD_SENSORS][BOARD_ROW];
static struct discipline clock;
static struct event event[BOARD_SENSORS];

static uint32_t mark;      /* when the present frame's pulse began, or was due */
static bool heard;         /* … and whether it came */
static bool ever_heard;
static bool clock_known;   /* accurate enough to transmit */
static uint16_t code[BOARD_SENSORS]; /* of the plan */

#define EACH_SENSOR uint8_t s = 0; s < BOARD_SENSORS; s++

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

static uint16_t measured_code(uint8_t sensor)
{
    return (uint16_t)(board_measure(sensor) >> (10u - record[0].bits));
}

static void learn_rest(uint16_t *rest)
{
    for (EACH_SENSOR)
        rest[s] = REST_READINGS / 2;
    for (uint8_t i = 0; i < REST_READINGS; i++) {
        for (EACH_SENSOR)
            rest[s] = (uint16_t)(rest[s] + measured_code(s));
        wait(board_now() + 8 * MS);
    }
    for (EACH_SENSOR)
        rest[s] /= REST_READINGS;
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
    sensor_set talks = 0, ready = clock_known && !number_lacks() ? (sensor_set)((1u << BOARD_SENSORS) - 1u) : 0;

    talk_stop();
    for (EACH_SENSOR) {
        code[s] = measured_code(s);
        talks = (sensor_set)(talks | event_talks(&event[s], code[s]) << s);
    }
    talk_plan(&clock, code, talks & ready, ready);
}

static void begin(const uint16_t *rest)
{
    for (EACH_SENSOR)
        event_init(&event[s], &record[s], rest[s]);
    discipline_init(&clock, record, BOARD_TICKS_PER_US);
    clock_known = !record[0].discipline;
    talk_init(record, row[0]);
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
    for (EACH_SENSOR)
        event_frame(&event[s], frame.others >> s & 1u, frame.spoke >> s & 1u, code[s]);
    if (BOARD_TAKES_NUMBER && number_heard(frame.turn, event_farther(code[0], event[0].rest, PRESSED << record[0].bits >> 8),
                                           record, row[0], &limits))
        begin(&event[0].rest);
}

/* No pulse came: counts the frame all the same, so that heartbeats keep their turns. */
static void frame_missed(void)
{
    mark += clock.period;
    heard = false;
    tell(false);
    talk_expect(mark + clock.period);
    if (!ever_heard)
        return;
    for (EACH_SENSOR)
        event_frame(&event[s], false, false, code[s]);
}

/* On the wire of the record; without one, as the node is wired. */
static void listen(bool fault)
{
    bool joined = board_is_joined(), on_data = fault ? joined : record[0].version == TP_NODE_VERSION_DATA;

    board_listen(on_data, joined == on_data);
}

int main(void)
{
    enum node_memory_fault fault;
    uint16_t rest[BOARD_SENSORS];

    board_init();
    sei();
    fault = number_load(record, row[0], &limits);
    if (BOARD_HEARS_OWN && BOARD_HEARS_DATA)
        listen(fault);
    if (fault)
        blink(fault);

    for (EACH_SENSOR)
        rest[s] = record[s].rest;
    if (rest[0] == TP_NODE_LEARN_REST)
        learn_rest(rest);
    begin(rest);
    mark = board_now();
    for (;;) {
        plan();
        if (wait(mark + clock.period + clock.period / 2))
            frame_began();
        else
            frame_missed();
        /* an early pulse begins a frame, too, but this node has no plan for it and stays silent */
        while (wait(mark + clock.period - BOARD_READING_US * (uint32_t)BOARD_TICKS_PER_US))
            frame_began();
    }
}
