// SPDX-License-Identifier: Apache-2.0

#include "avr_usart.h"

#include <stddef.h>

enum { UCSR0A = 0xC0, UCSR0B, UCSR0C, UBRR0L = 0xC4, UBRR0H, UDR0 };
enum { UDRE0 = 5, TXEN0 = 3, MASTER = 0xC0, LEAST_FIRST = 0x04 };

static void show(struct avr_usart *usart, avr_cycle_count_t cycle, int8_t level)
{
    if (level == usart->level)
        return;
    usart->level = level;
    usart->changed(usart->param, cycle, level);
}

/* The level between octets. */
static int8_t idle_level(const struct avr_usart *usart)
{
    return usart->enabled ? 1 : 0;
}

static void show_bit(struct avr_usart *usart)
{
    bool least_first = usart->avr->data[UCSR0C] & LEAST_FIRST;

    show(usart, usart->tick, usart->shift & (least_first ? 0x01 : 0x80) ? 1 : -1);
    usart->shift = (uint8_t)(least_first ? usart->shift >> 1 : usart->shift << 1);
}

static void take_octet(struct avr_usart *usart)
{
    usart->shift = usart->buffer;
    usart->full = false;
    usart->shifting = true;
    usart->second_half = false;
    usart->bits_left = 8;
    show_bit(usart);
}

static void tick(struct avr_usart *usart)
{
    if (usart->shifting) {
        usart->second_half = !usart->second_half;
        if (usart->second_half)
            return;
        if (--usart->bits_left) {
            show_bit(usart);
            return;
        }
        usart->shifting = false;
    }
    if (usart->full)
        take_octet(usart);
    else
        show(usart, usart->tick, idle_level(usart));
}

static void run_to(struct avr_usart *usart, avr_cycle_count_t cycle)
{
    while (usart->tick <= cycle && (usart->shifting || usart->full)) {
        tick(usart);
        usart->tick += usart->period;
    }
    if (usart->tick <= cycle)
        usart->tick += ((cycle - usart->tick) / usart->period + 1) * usart->period;
}

static void apply(struct avr_usart *usart, avr_cycle_count_t cycle)
{
    const uint8_t *data = usart->avr->data;
    uint8_t value = usart->value_written;

    switch (usart->register_written) {
    case UBRR0L:
        usart->period = (data[UBRR0H] << 8 | value) + 1u;
        usart->tick = cycle + usart->period;
        break;
    case UCSR0B:
        usart->enabled = value >> TXEN0 & 1;
        usart->faults += value & ~(1u << TXEN0) || (usart->enabled && (data[UCSR0C] & MASTER) != MASTER);
        if (!usart->shifting && !usart->full)
            show(usart, cycle, idle_level(usart));
        break;
    case UDR0:
        usart->faults += usart->full || !usart->enabled;
        usart->buffer = value;
        usart->full = usart->enabled;
        break;
    }
    usart->register_written = 0;
}

void avr_usart_run(struct avr_usart *usart)
{
    run_to(usart, usart->avr->cycle);
    if (usart->register_written)
        apply(usart, usart->avr->cycle);
}

static void on_write(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    struct avr_usart *usart = param;

    avr->data[address] = value;
    usart->register_written = (uint8_t)address;
    usart->value_written = value;
    avr->run_cycle_count = 0; /* ends avr_run_one with this instruction */
}

static uint8_t on_read(avr_t *avr, avr_io_addr_t address, void *param)
{
    struct avr_usart *usart = param;

    (void)address;
    run_to(usart, avr->cycle);
    return (uint8_t)(!usart->full << UDRE0);
}

void avr_usart_reset(struct avr_usart *usart)
{
    usart->enabled = usart->full = usart->shifting = false;
    usart->period = 1;
    usart->tick = usart->avr->cycle + 1;
    usart->register_written = 0;
    show(usart, usart->avr->cycle, 0);
}

void avr_usart_init(struct avr_usart *usart, avr_t *avr,
                    void (*changed)(void *, avr_cycle_count_t, int8_t), void *param)
{
    static const uint8_t written[] = {UCSR0B, UBRR0L, UDR0};

    *usart = (struct avr_usart){.changed = changed, .param = param, .avr = avr};
    avr_usart_reset(usart);
    for (size_t i = 0; i < sizeof written; i++) {
        avr_io_addr_t io = AVR_DATA_TO_IO(written[i]);
        avr->io[io].w.c = on_write;
        avr->io[io].w.param = usart;
    }
    for (uint8_t address = UCSR0A; address <= UCSR0C; address += 2) /* C: simavr's would reset its own */
        avr->io[AVR_DATA_TO_IO(address)].w.c = NULL;
    avr->io[AVR_DATA_TO_IO(UCSR0A)].r.c = on_read;
    avr->io[AVR_DATA_TO_IO(UCSR0A)].r.param = usart;
}
