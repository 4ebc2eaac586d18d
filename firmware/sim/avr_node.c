// SPDX-License-Identifier: Apache-2.0

#include "avr_node.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <simavr/avr_acomp.h>
#include <simavr/avr_adc.h>
#include <simavr/avr_eeprom.h>
#include <simavr/avr_extint.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_timer.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_core.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_interrupts.h>

#include "avr_usart.h"

#define RESPONSE_CYCLES 4 /* to an interrupt, and as many again out of sleep */
#define CANCELLER_CYCLES 4 /* for which a noise canceller wants a level to last */
#define CODES 1024        /* of the converter */
/* simavr's converter gives ⌊mV · 1023 / supply in mV⌋: with this supply, mV are codes */
#define SUPPLY_OF_CODES 1023

#define MOST_SENSORS 4
#define PULL_CYCLES 1 /* for which a line may be pulled up between two instructions that release or drive it */

/* A microcontroller's pins with an image, and registers that simavr doesn't name. */
struct wiring {
    const char *mcu, *core; /* its name here, and simavr's */
    bool usart;             /* TXD is the output pin */
    uint8_t sync_pin;       /* of port B; the LED's on the data wire */
    char out_port;
    uint8_t out_pin;
    uint8_t sensors;      /* 1; of more each has a line, on the pins from out_pin on, and a channel, from `sensor` on */
    char led_port;
    uint8_t led_pin;
    uint8_t sensor;       /* channel of the converter */
    avr_regbit_t foc;     /* force output compare A of Timer1 */
    avr_regbit_t psr;     /* reset of Timer0's prescaler, beside foc; or none */
    avr_regbit_t sleep;   /* SE */
    avr_regbit_t mode;    /* SM, of which 0 is idle */
    avr_regbit_t canceller; /* of the sync pin's capture; or none */
    avr_io_addr_t divider;  /* CLKPR */
    bool joined;            /* on the data wire: the LED's pin is AIN1, and the LED at the sync pin */
};

#define ATMEGA328P(name, is_usart, port, pin, count)                                               \
    {.mcu = name, .core = "atmega328p", .usart = is_usart, .sync_pin = 0, .out_port = port,         \
     .out_pin = pin, .sensors = count, .led_port = 'D', .led_pin = 7, .sensor = 0,                                    \
     .foc = {.reg = 0x82, .bit = 7, .mask = 1}, .sleep = {.reg = 0x53, .bit = 0, .mask = 1},         \
     .mode = {.reg = 0x53, .bit = 1, .mask = 7}, .canceller = {.reg = 0x81, .bit = 7, .mask = 1},           \
     .divider = 0x61, .joined = !is_usart}

#define ATTINY85(name)                                                                             \
    {.mcu = name, .core = "attiny85", .sync_pin = 2, .out_port = 'B', .out_pin = 1,                 \
     .sensors = 1, .led_port = 'B', .led_pin = 4, .sensor = 3, .foc = {.reg = 0x4C, .bit = 2, .mask = 1},          \
     .psr = {.reg = 0x4C, .bit = 0, .mask = 1}, .sleep = {.reg = 0x55, .bit = 5, .mask = 1},         \
     .mode = {.reg = 0x55, .bit = 3, .mask = 3}, .divider = 0x46}

static const struct wiring wirings[] = {
    ATMEGA328P("atmega328p", false, 'B', 1, 1),
    ATMEGA328P("atmega328p-fast", true, 'D', 1, 1),
    ATMEGA328P("atmega328p-four", false, 'D', 2, MOST_SENSORS),
    ATTINY85("attiny85"),
    ATTINY85("attiny85-data"),
};

/* A register whose writes are observed, with simavr's own handler or NULL. */
struct tap {
    struct avr_node *node;
    avr_io_write_t write;
    void *param;
};

enum { TAP_DDR, TAP_PORT, TAP_PIN, TAP_COM, TAP_FOC, TAP_CLOCK, TAP_AIN1, TAP_COMPARATOR, TAPS };

/* An output pin, as its driver has it, and its edges. */
struct line {
    bool driven, port_bit;
    avr_cycle_count_t pulled; /* cycle since which it is released into its pull-up; 0: it is not */

    struct pin_edge *edges;
    size_t size, capacity;
    int8_t before;
};

struct avr_node {
    avr_t *avr;
    avr_run_t run; /* simavr's own; another where a watchdog reset is due */
    const struct wiring *wiring;
    avr_ioport_t *port, *out, *led; /* port: of the sync pin */
    avr_timer_t *timer;
    avr_timer_t *prescaled;        /* Timer0, if its prescaler is modelled */
    int64_t prescaler;             /* cycle at which that one was 0 */
    uint64_t crystal_mhz, clock_mhz; /* millihertz; the clock is the crystal's, divided */
    int64_t from_ns;                 /* when it was divided so */
    avr_cycle_count_t from;
    bool divided_anew;
    double supply_v;
    int64_t start_ns, delay_ns;

    const struct sync_line *sync;
    uint64_t seen;                 /* edges of the sync line */
    avr_cycle_count_t sync_cycle;  /* of the next one */
    bool sync_level;
    avr_cycle_count_t settled;     /* cycle at which the canceller lets an edge through, or UINT64_MAX */

    double bandgap_v;              /* of the data wire's comparator; 0: a wire of their own */
    avr_acomp_t *comparator;
    int8_t ain1;                   /* what its pins drive */
    avr_cycle_count_t freed;       /* at which AIN1, driven before, follows the line again, or UINT64_MAX */

    struct avr_usart usart;
    struct tap taps[TAPS];
    bool touched;        /* a register of the output pins was written, by the last instruction */
    bool latched, latch; /* the output pin of one sensor */
    struct line lines[MOST_SENSORS];

    struct node_counters counters;
};

/* Time */

static avr_cycle_count_t cycle_at(const struct avr_node *node, int64_t t_ns)
{
    /* the first clock edge at or after it */
    __int128 scaled = (__int128)(t_ns - node->from_ns) * node->clock_mhz;
    return node->from + (scaled <= 0 ? 0 : (avr_cycle_count_t)((scaled + 999999999999) / 1000000000000));
}

static int64_t time_of(const struct avr_node *node, avr_cycle_count_t cycle)
{
    __int128 scaled = (__int128)(cycle - node->from) * 1000000000000 + node->clock_mhz / 2;
    return node->from_ns + (int64_t)(scaled / node->clock_mhz);
}

static void divide_clock(struct avr_node *node, uint8_t log2)
{
    uint64_t clock_mhz = node->crystal_mhz >> log2;

    if (clock_mhz == node->clock_mhz)
        return;
    node->from_ns = time_of(node, node->avr->cycle);
    node->from = node->avr->cycle;
    node->clock_mhz = clock_mhz;
    node->avr->frequency = (uint32_t)((clock_mhz + 500) / 1000);
    node->divided_anew = true;
}

/* The output pin */

static void log_edge(struct avr_node *node, struct line *line, avr_cycle_count_t cycle, int8_t level)
{
    int64_t t_ns = time_of(node, cycle);
    struct pin_edge *last = line->size ? &line->edges[line->size - 1] : NULL;

    if (last && last->t_ns == t_ns) { /* a level of zero duration is no edge */
        line->size--;
        last = line->size ? last - 1 : NULL;
    }
    if (level == (last ? last->level : line->before))
        return;
    if (line->size == line->capacity) {
        line->capacity = 2 * line->capacity + 256;
        line->edges = realloc(line->edges, line->capacity * sizeof *line->edges);
    }
    line->edges[line->size++] = (struct pin_edge){t_ns, level};
}

/* Has the comparator see what its pins drive, or the line. */
static void show_ain1(struct avr_node *node)
{
    double line_v = node->sync_level ? node->sync->low_v : node->sync->rest_v;
    double volts = node->ain1 > 0 ? node->supply_v : node->ain1 < 0 ? 0 : line_v;

    avr_raise_irq(avr_io_getirq(node->avr, AVR_IOCTL_ACOMP_GETIRQ, ACOMP_IRQ_AIN1),
                  (uint32_t)lround(volts / node->bandgap_v * ACOMP_BANDGAP));
}

/* The line's pin, and AIN1 that is joined with it, are driven to a level, or released. */
static void drive_ain1(struct avr_node *node, int8_t level)
{
    const uint8_t *data = node->avr->data;
    uint8_t bit = (uint8_t)(1u << node->wiring->led_pin);

    if (node->wiring->joined && data[node->led->r_ddr] & bit)
        level = data[node->led->r_port] & bit ? 1 : -1;
    if (level) {
        node->ain1 = level;
        node->freed = UINT64_MAX;
        show_ain1(node);
    } else if (node->ain1 && node->freed == UINT64_MAX) {
        node->freed = node->avr->cycle + (uint64_t)node->delay_ns * node->clock_mhz / 1000000000000u;
    }
}

static void log_level(struct avr_node *node)
{
    for (int i = 0; i < node->wiring->sensors; i++) {
        struct line *line = &node->lines[i];
        bool high = node->latched ? node->latch : line->port_bit;
        int8_t level = !line->driven ? 0 : high ? 1 : -1;

        if (node->wiring->usart && node->usart.level)
            level = node->usart.level;
        log_edge(node, line, node->avr->cycle, level);
        if (node->bandgap_v > 0 && i == 0)
            drive_ain1(node, level);
    }
}

static void on_usart(void *param, avr_cycle_count_t cycle, int8_t level)
{
    struct avr_node *node = param;

    log_edge(node, &node->lines[0], cycle, level);
}

static uint8_t compare_mode(const struct avr_node *node)
{
    return avr_regbit_get(node->avr, node->timer->comp[AVR_TIMER_COMPA].com);
}

static void match(struct avr_node *node)
{
    uint8_t mode = compare_mode(node);
    node->latch = mode == avr_timer_com_toggle ? !node->latch : mode == avr_timer_com_set;
    log_level(node);
}

/* simavr raises this with the mode's level on a match, and with the opposite one on overflow */
static void on_compare(avr_irq_t *irq, uint32_t value, void *param)
{
    struct avr_node *node = param;
    uint8_t mode = compare_mode(node);

    (void)irq;
    if (mode == avr_timer_com_toggle || (value & 1) == (mode == avr_timer_com_set))
        match(node);
}

/* Takes a line as its registers have it. */
static void settle_line(struct avr_node *node, struct line *line, uint8_t bit)
{
    uint8_t *data = node->avr->data;
    avr_cycle_count_t now = node->avr->cycle;
    bool pulled_up;

    line->driven = data[node->out->r_ddr] & bit;
    line->port_bit = data[node->out->r_port] & bit;
    pulled_up = !line->driven && line->port_bit;
    if (pulled_up && !line->pulled)
        line->pulled = now;
    if (!pulled_up && line->pulled) {
        node->counters.pull_ups += now - line->pulled > PULL_CYCLES;
        line->pulled = 0;
    }
}

/* Applies the last instruction's writes to the pins. */
static void settle_pin(struct avr_node *node)
{
    uint8_t *data = node->avr->data;

    for (int i = 0; i < node->wiring->sensors; i++)
        settle_line(node, &node->lines[i], (uint8_t)(1u << (node->wiring->out_pin + i)));
    node->latched = node->wiring->sensors == 1 && !node->wiring->usart && compare_mode(node) != avr_timer_com_normal;
    node->counters.faults += !(node->bandgap_v > 0) && data[node->port->r_ddr] & 1u << node->wiring->sync_pin;
    if (avr_regbit_get(node->avr, node->wiring->foc)) {
        avr_regbit_clear(node->avr, node->wiring->foc);
        if (node->latched)
            match(node);
    }
    log_level(node);
    if (node->prescaled && avr_regbit_get(node->avr, node->wiring->psr)) {
        avr_regbit_clear(node->avr, node->wiring->psr);
        node->prescaler = (int64_t)node->avr->cycle;
    }
    node->touched = false;
}

/* Registers */

static void tapped_write(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    struct tap *tap = param;

    if (tap->write)
        tap->write(avr, address, value, tap->param);
    else
        avr->data[address] = value;
    tap->node->touched = true;
    avr->run_cycle_count = 0; /* ends avr_run_one with this instruction */
}

static void tap(struct avr_node *node, int which, avr_io_addr_t address)
{
    avr_io_addr_t io = AVR_DATA_TO_IO(address);

    node->taps[which] = (struct tap){node, node->avr->io[io].w.c, node->avr->io[io].w.param};
    node->avr->io[io].w.c = tapped_write;
    node->avr->io[io].w.param = &node->taps[which];
}

/* A prescaler runs freely: a timer connected to it first counts at the prescaler's next wrap. */
static void prescaled_write(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    struct tap *tap = param;
    const avr_timer_t *timer = tap->node->prescaled;
    avr_cycle_count_t now = avr->cycle;
    uint8_t select = value & 7;

    if (select)
        avr->cycle -= (uint64_t)((int64_t)now - tap->node->prescaler) &
                      ((1u << timer->cs_div[select]) - 1u);
    tap->write(avr, address, value, tap->param);
    avr->cycle = now;
}

/* simavr leaves a cleared interrupt in its queue and queues it again when it is raised again; a full
 * queue loses other interrupts for ever. */
static void clear_interrupt(avr_t *avr, avr_int_vector_t *vector)
{
    avr_int_pending_t *queue = &avr->interrupts.pending;
    uint16_t kept = queue->read;

    avr_clear_interrupt(avr, vector);
    for (uint16_t i = queue->read; i != queue->write; i = (i + 1u) % avr_int_pending_fifo_size) {
        if (queue->buffer[i] == vector)
            continue;
        queue->buffer[kept] = queue->buffer[i];
        kept = (kept + 1u) % avr_int_pending_fifo_size;
    }
    queue->write = kept;
    if (avr->interrupt_state > 0 && !avr_has_pending_interrupts(avr))
        avr->interrupt_state = 0;
}

static void write_flags(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    (void)param;
    for (int i = 0; i < avr->interrupts.vector_count; i++) {
        avr_int_vector_t *vector = avr->interrupts.vector[i];
        if (vector->raised.reg == address && (value >> vector->raised.bit & 1))
            clear_interrupt(avr, vector);
    }
}

static void write_mask(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    (void)param;
    avr->data[address] = value;
    for (int i = 0; i < avr->interrupts.vector_count; i++) {
        avr_int_vector_t *vector = avr->interrupts.vector[i];
        if (vector->enable.reg == address && avr_regbit_get(avr, vector->enable) &&
            avr_regbit_get(avr, vector->raised))
            avr_raise_interrupt(avr, vector);
    }
}

static void replace_write(avr_t *avr, avr_io_addr_t address, avr_io_write_t write)
{
    avr->io[AVR_DATA_TO_IO(address)].w.c = write;
    avr->io[AVR_DATA_TO_IO(address)].w.param = NULL;
}

static void replace_interrupt(avr_t *avr, const avr_int_vector_t *vector)
{
    replace_write(avr, vector->raised.reg, write_flags);
    replace_write(avr, vector->enable.reg, write_mask);
}

/* CLKPR: after CLKPCE alone has been written, the clock's division. Its time limit is left out. */
static void write_divider(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    bool allowed = avr->data[address] == 0x80;

    avr->data[address] = value;
    if (allowed && !(value & 0x80))
        divide_clock(param, value & 0x0F);
    avr->run_cycle_count = 0;
}

/* Peripherals */

static void *peripheral(avr_t *avr, const char *kind, char name)
{
    for (avr_io_t *io = avr->io_port; io; io = io->next) {
        if (strcmp(io->kind, kind))
            continue;
        if (!name || (!strcmp(kind, "port") && ((avr_ioport_t *)io)->name == name) ||
            (!strcmp(kind, "timer") && ((avr_timer_t *)io)->name == name))
            return io;
    }
    return NULL;
}

/* Sets the sync pin's level, which nothing but the program sees yet. */
static void show_sync_level(struct avr_node *node)
{
    uint8_t *pins = &node->avr->data[node->port->r_pin];
    uint8_t bit = (uint8_t)(1u << node->wiring->sync_pin);

    *pins = node->sync_level ? *pins | bit : *pins & (uint8_t)~bit;
}

/* Sets it without an edge. */
static void start_sync_level(struct avr_node *node)
{
    if (node->bandgap_v > 0) {
        show_ain1(node);
        return;
    }
    node->port->io.irq[node->wiring->sync_pin].value = node->sync_level;
    show_sync_level(node);
}

/* After each reset: undoes connections that simavr makes by itself, restores what it forgets. */
static void after_reset(struct avr_node *node)
{
    divide_clock(node, 0);
    avr_extint_set_strict_lvl_trig(node->avr, 0, 0);
    avr_unconnect_irq(&node->timer->io.irq[TIMER_IRQ_OUT_COMP + AVR_TIMER_COMPA],
                      &node->port->io.irq[node->wiring->out_pin]);
    start_sync_level(node);
    node->settled = node->freed = UINT64_MAX;
    node->ain1 = 0;
    if (node->wiring->usart)
        avr_usart_reset(&node->usart);
    node->latch = false;
    settle_pin(node);
}

/* Writes ACSR. ACO is read only, and a one clears ACI (simavr takes both as they are written). ACIC: simavr connects
 * the comparator with the capture unit; here the canceller is between them. */
static void write_comparator(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    struct tap *tap = param;
    avr_acomp_t *comparator = tap->node->comparator;
    avr_int_vector_t *vector = &comparator->ac;
    uint8_t raised = (uint8_t)(1u << vector->raised.bit), kept = (uint8_t)(raised | 1u << comparator->aco.bit);

    tap->write(avr, address, (uint8_t)((value & ~kept) | (avr->data[address] & kept)), tap->param);
    if (value & raised)
        clear_interrupt(avr, vector);
    else if (avr_regbit_get(avr, vector->enable) && avr_regbit_get(avr, vector->raised))
        avr_raise_interrupt(avr, vector);
    if (comparator->timer_irq)
        avr_unconnect_irq(&comparator->io.irq[ACOMP_IRQ_OUT], comparator->timer_irq);
}

static void on_comparator(avr_irq_t *irq, uint32_t value, void *param)
{
    struct avr_node *node = param;
    bool waits = node->settled != UINT64_MAX;

    (void)irq, (void)value;
    if (avr_regbit_get(node->avr, node->comparator->acic))
        node->settled = waits ? UINT64_MAX : node->avr->cycle + CANCELLER_CYCLES;
}

static void prepare_comparator(struct avr_node *node)
{
    tap(node, TAP_AIN1, node->led->r_ddr);
    tap(node, TAP_COMPARATOR, node->comparator->r_acsr);
    node->avr->io[AVR_DATA_TO_IO(node->comparator->r_acsr)].w.c = write_comparator;
    avr_irq_register_notify(&node->comparator->io.irq[ACOMP_IRQ_OUT], on_comparator, node);
}

static void prepare(struct avr_node *node)
{
    avr_t *avr = node->avr;
    avr_extint_t *extint = peripheral(avr, "extint", 0);

    node->port = peripheral(avr, "port", 'B');
    node->out = peripheral(avr, "port", node->wiring->out_port);
    node->led = peripheral(avr, "port", node->wiring->led_port);
    node->timer = peripheral(avr, "timer", '1');
    node->comparator = peripheral(avr, "ac", 0);
    if (!node->timer->wgm[0].reg) { /* the ATtiny85's, of which simavr knows little */
        node->timer->wgm_op[0] = (avr_timer_wgm_t)AVR_TIMER_WGM_NORMAL8();
        for (uint8_t select = 1; select < 16; select++)
            node->timer->cs_div[select] = (uint8_t)(select - 1);
    }
    replace_interrupt(avr, &node->timer->overflow);
    replace_interrupt(avr, &extint->eint[0].vector);
    tap(node, TAP_DDR, node->out->r_ddr);
    tap(node, TAP_PORT, node->out->r_port);
    tap(node, TAP_PIN, node->out->r_pin);
    tap(node, TAP_COM, node->timer->comp[AVR_TIMER_COMPA].com.reg);
    tap(node, TAP_FOC, node->wiring->foc.reg);
    avr_register_io_write(avr, node->wiring->divider, write_divider, node);
    if (node->wiring->psr.reg) {
        node->prescaled = peripheral(avr, "timer", '0');
        tap(node, TAP_CLOCK, node->prescaled->cs[0].reg);
        avr->io[AVR_DATA_TO_IO(node->prescaled->cs[0].reg)].w.c = prescaled_write;
        /* its phase at power-up is arbitrary: it has run since time 0 */
        node->prescaler = -(int64_t)((__int128)node->start_ns * node->clock_mhz / 1000000000000);
    }
    if (node->bandgap_v > 0)
        prepare_comparator(node);
    if (node->wiring->usart)
        avr_usart_init(&node->usart, avr, on_usart, node);
    avr_irq_register_notify(&node->timer->io.irq[TIMER_IRQ_OUT_COMP + AVR_TIMER_COMPA],
                            on_compare, node);
    avr->vcc = avr->avcc = SUPPLY_OF_CODES;
    avr->aref = SUPPLY_OF_CODES / 2; /* a capacitor, and no reference */
    after_reset(node);
}

/* Running */

static const struct sync_edge *next_edge(const struct avr_node *node)
{
    uint64_t next = node->seen - node->sync->dropped;

    return next < node->sync->size ? &node->sync->edges[next] : NULL;
}

/* Determines the cycle of the sync line's next edge. */
static void look_ahead(struct avr_node *node)
{
    const struct sync_edge *edge = next_edge(node);
    int64_t back_ns = node->bandgap_v > 0 && edge && !edge->level ? node->sync->back_ns : 0;

    node->sync_cycle = edge ? cycle_at(node, edge->t_ns + node->delay_ns + back_ns) : UINT64_MAX;
}

/* Skips edges before power-up, of which only the resulting level counts. */
static void skip_past(struct avr_node *node)
{
    for (const struct sync_edge *edge; (edge = next_edge(node)) && edge->t_ns + node->delay_ns <= node->start_ns;
         node->seen++)
        node->sync_level = edge->level;
    start_sync_level(node);
}

/* The sync pin's level, or the comparator's, reaches whatever listens to its edges. */
static void pass_edge(struct avr_node *node)
{
    node->settled = UINT64_MAX;
    if (node->bandgap_v > 0) {
        avr_raise_irq(&node->timer->io.irq[TIMER_IRQ_IN_ICP],
                      avr_regbit_get(node->avr, node->comparator->aco));
        return;
    }
    if (node->wiring->canceller.reg && avr_regbit_get(node->avr, node->comparator->acic))
        return; /* the capture unit hears the comparator, and in simavr the pin, too */
    avr_raise_irq(&node->port->io.irq[node->wiring->sync_pin], node->sync_level);
}

static void take_edge(struct avr_node *node)
{
    bool waits = node->settled != UINT64_MAX;

    node->sync_level = next_edge(node)->level;
    node->seen++;
    look_ahead(node);
    if (node->bandgap_v > 0) {
        show_ain1(node);
        return;
    }
    if (!node->wiring->canceller.reg || !avr_regbit_get(node->avr, node->wiring->canceller)) {
        pass_edge(node);
        return;
    }
    show_sync_level(node); /* the program sees it at once */
    node->settled = waits ? UINT64_MAX : node->avr->cycle + CANCELLER_CYCLES;
}

static avr_cycle_count_t next_event(const struct avr_node *node)
{
    const struct avr_cycle_timer_slot_t *timer = node->avr->cycle_timers.timer;
    avr_cycle_count_t next = node->sync_cycle < node->settled ? node->sync_cycle : node->settled;

    next = node->freed < next ? node->freed : next;

    return timer && timer->when < next ? timer->when : next;
}

/* Processes all events due by now, each at its own cycle. */
static void process_events(struct avr_node *node)
{
    avr_t *avr = node->avr;
    avr_cycle_count_t now = avr->cycle;

    for (;;) {
        avr_cycle_count_t due = next_event(node);
        if (due > now || avr->run != node->run)
            break;
        avr->cycle = due;
        if (due == node->settled) {
            pass_edge(node);
        } else if (due == node->freed) {
            node->freed = UINT64_MAX;
            node->ain1 = 0;
            show_ain1(node);
        } else if (due == node->sync_cycle) {
            take_edge(node);
        } else {
            avr_cycle_timer_process(avr);
        }
    }
    avr->cycle = now;
}

/* Runs instructions until one reaches the next event, changes its time, touches the output pin, allows
 * interrupts or sleeps. (simavr leaves its loop when a timer is set: its limit is 1.) */
static void run_instructions(struct avr_node *node, avr_cycle_count_t event)
{
    avr_t *avr = node->avr;

    avr->run_cycle_count = event > avr->cycle ? event - avr->cycle : 0;
    avr->pc = avr_run_one(avr);
    if (avr->state != cpu_Sleeping)
        return;
    if (!avr_regbit_get(avr, node->wiring->sleep))
        avr->state = cpu_Running;
    else if (avr_regbit_get(avr, node->wiring->mode))
        node->counters.deep_sleeps++;
}

static void respond(struct avr_node *node, bool slept)
{
    avr_t *avr = node->avr;
    bool enabled = avr->sreg[S_I];

    avr_service_interrupts(avr);
    if (enabled && !avr->sreg[S_I])
        avr->cycle += slept ? 2 * RESPONSE_CYCLES : RESPONSE_CYCLES;
}

static void reset_by_watchdog(struct avr_node *node)
{
    node->avr->run(node->avr); /* also restores simavr's own `run` */
    node->counters.watchdog_resets++;
    after_reset(node);
}

/* Applies what has happened by now. */
static void catch_up(struct avr_node *node)
{
    process_events(node);
    if (node->wiring->usart)
        avr_usart_run(&node->usart);
    if (node->touched)
        settle_pin(node);
}

void node_run(struct avr_node *node, int64_t t_ns)
{
    avr_t *avr = node->avr;
    avr_cycle_count_t end = cycle_at(node, t_ns);

    if (!avr->cycle)
        skip_past(node);
    look_ahead(node);
    while (avr->cycle < end) {
        avr_cycle_count_t begin = avr->cycle, event;
        bool asleep = avr->state != cpu_Running;

        catch_up(node);
        if (avr->run != node->run)
            reset_by_watchdog(node);
        else if (avr->interrupt_state)
            respond(node, asleep);
        event = next_event(node) < end ? next_event(node) : end;
        if (avr->state == cpu_Running) {
            run_instructions(node, event);
            node->counters.cycles_awake += avr->cycle - begin;
        } else {
            avr->cycle = event;
            node->counters.cycles_asleep += avr->cycle - begin;
        }
        if (node->divided_anew) {
            node->divided_anew = false;
            end = cycle_at(node, t_ns);
            look_ahead(node);
        }
    }
    catch_up(node);
}

/* Connections */

int node_sensors(const struct avr_node *node)
{
    return node->wiring->sensors;
}

void node_sense(struct avr_node *node, int sensor, double volts)
{
    double code = floor(volts / node->supply_v * CODES + 0.5); /* ideal: code 1 begins at half a count */
    uint32_t clipped = code <= 0 ? 0 : code >= CODES - 1 ? CODES - 1 : (uint32_t)code;

    avr_raise_irq(avr_io_getirq(node->avr, AVR_IOCTL_ADC_GETIRQ,
                                (int)(ADC_IRQ_ADC0 + node->wiring->sensor) + sensor),
                  clipped);
}

size_t node_edges(const struct avr_node *node, int sensor, const struct pin_edge **edges, int8_t *before)
{
    const struct line *line = &node->lines[sensor];

    *edges = line->edges;
    *before = line->before;
    return line->size;
}

uint64_t node_seen(const struct avr_node *node)
{
    return node->seen;
}

static void forget(struct line *line, int64_t t_ns)
{
    size_t old = 0;

    while (old < line->size && line->edges[old].t_ns < t_ns)
        old++;
    if (!old)
        return;
    line->before = line->edges[old - 1].level;
    line->size -= old;
    memmove(line->edges, line->edges + old, line->size * sizeof *line->edges);
}

void node_forget(struct avr_node *node, int64_t t_ns)
{
    for (int i = 0; i < node->wiring->sensors; i++)
        forget(&node->lines[i], t_ns);
}

size_t node_memory(struct avr_node *node, uint8_t *bytes, size_t size)
{
    size_t all = node->avr->e2end + 1u;
    avr_eeprom_desc_t content = {.ee = bytes, .size = (uint32_t)(size < all ? size : all)};

    avr_ioctl(node->avr, AVR_IOCTL_EEPROM_GET, &content);
    return content.size;
}

bool node_led(const struct avr_node *node)
{
    const uint8_t *data = node->avr->data;

    if (node->bandgap_v > 0 && node->wiring->joined)
        return data[node->port->r_ddr] & data[node->port->r_port] & 1u << node->wiring->sync_pin;
    return data[node->led->r_ddr] & data[node->led->r_port] & 1u << node->wiring->led_pin;
}

void node_count(const struct avr_node *node, struct node_counters *counters)
{
    *counters = node->counters;
    for (int i = 0; i < node->wiring->sensors; i++)
        counters->pull_ups += node->lines[i].pulled && node->avr->cycle - node->lines[i].pulled > PULL_CYCLES;
    counters->faults += node->usart.faults;
}

/* Powering up */

static void count_faults(avr_t *avr, const int level, const char *format, va_list arguments)
{
    (void)format;
    (void)arguments;
    if (avr && avr->custom.data && (level == LOG_ERROR || level == LOG_WARNING))
        ((struct avr_node *)avr->custom.data)->counters.faults++;
}

static const struct wiring *wiring_of(const char *mcu)
{
    for (size_t i = 0; i < sizeof wirings / sizeof *wirings; i++)
        if (!strcmp(wirings[i].mcu, mcu))
            return &wirings[i];
    return NULL;
}

/* Loads an image; returns the reason if it cannot be loaded, else NULL. */
static const char *load(avr_t *avr, const struct node_plan *plan)
{
    elf_firmware_t firmware = {0};
    const char *obstacle = NULL;

    if (plan->flash_size > avr->flashend + 1)
        return "an image larger than its flash";
    if (plan->flash_size) {
        memcpy(avr->flash, plan->flash, plan->flash_size);
        avr->codeend = (uint32_t)plan->flash_size;
        return NULL;
    }
    if (elf_read_firmware(plan->image, &firmware))
        return "no ELF image";
    if (!firmware.flashsize)
        obstacle = "an image without code";
    else if (firmware.flashbase + firmware.flashsize > avr->flashend + 1)
        obstacle = "an image larger than its flash";
    else
        avr_load_firmware(avr, &firmware);
    free(firmware.flash);
    return obstacle;
}

struct avr_node *node_create(const struct node_plan *plan, const struct sync_line *sync,
                             char *error, size_t error_size)
{
    const struct wiring *wiring = wiring_of(plan->mcu);
    const char *obstacle;
    struct avr_node *node;

    avr_global_logger_set(count_faults);
    if (!wiring) {
        snprintf(error, error_size, "there is no wiring for the MCU %s", plan->mcu);
        return NULL;
    }
    node = calloc(1, sizeof *node);
    *node = (struct avr_node){.avr = avr_make_mcu_by_name(wiring->core), .wiring = wiring,
                              .crystal_mhz = (uint64_t)llround(plan->clock_hz * 1e3),
                              .clock_mhz = (uint64_t)llround(plan->clock_hz * 1e3),
                              .from_ns = plan->start_ns,
                              .supply_v = plan->supply_v, .start_ns = plan->start_ns,
                              .delay_ns = plan->delay_ns, .bandgap_v = plan->bandgap_v,
                              .sync = sync, .seen = sync->dropped};
    avr_init(node->avr);
    for (uint32_t i = node->avr->ioend + 1u; i <= node->avr->ramend; i++)
        node->avr->data[i] = (uint8_t)(i * 37u); /* RAM is full of rubbish at power-up */
    obstacle = load(node->avr, plan);
    if (!obstacle && plan->memory_size > node->avr->e2end + 1u)
        obstacle = "a memory larger than its EEPROM";
    if (obstacle) {
        snprintf(error, error_size, "%s: %s for the %s", plan->image, obstacle, plan->mcu);
        node_free(node);
        return NULL;
    }
    if (plan->memory_size) {
        avr_eeprom_desc_t content = {.ee = (uint8_t *)plan->memory,
                                     .size = (uint32_t)plan->memory_size};
        avr_ioctl(node->avr, AVR_IOCTL_EEPROM_SET, &content);
    }
    node->avr->custom.data = node;
    node->avr->frequency = (uint32_t)llround(plan->clock_hz);
    node->run = node->avr->run;
    prepare(node);
    return node;
}

void node_free(struct avr_node *node)
{
    if (!node)
        return;
    avr_terminate(node->avr);
    free(node->avr);
    for (int i = 0; i < MOST_SENSORS; i++)
        free(node->lines[i].edges);
    free(node);
}
