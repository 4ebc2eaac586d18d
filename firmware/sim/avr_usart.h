// SPDX-License-Identifier: Apache-2.0

/* The transmitter of an ATmega328P's USART 0 as master of a serial bus (UMSEL 11), which simavr lacks.
 *
 * By the data sheet: a divider counts UBRR0 + 1 cycles and is restarted by writing UBRR0L; two of its
 * ticks make a bit; a buffer holds the next octet; the transmitter, while enabled, drives TXD, high
 * between octets, and when it is disabled releases TXD after the last of them. Of what the data sheet does
 * not say it is assumed that an idle transmitter takes an octet at the first tick after it was written, and
 * that a write to UBRR0L does not change which half of a bit it is. Other modes, interrupts and TXC0 are
 * left out.
 */
#ifndef AVR_USART_H
#define AVR_USART_H

#include <stdbool.h>
#include <stdint.h>

#include <simavr/sim_avr.h>

struct avr_usart {
    /* Called when TXD changes: +1 high, −1 low, 0 released. */
    void (*changed)(void *param, avr_cycle_count_t cycle, int8_t level);
    void *param;

    avr_t *avr;
    bool enabled;            /* TXEN0 */
    bool full, shifting;     /* buffer, shift register */
    bool second_half;        /* of the present bit */
    uint8_t buffer, shift, bits_left;
    uint32_t period;         /* of the divider, cycles */
    avr_cycle_count_t tick;  /* its next one */
    int8_t level;
    uint32_t faults;         /* octets written into a full buffer; other modes than this */
    uint8_t register_written, value_written; /* by the last instruction; 0: none */
};

/* Takes the place of simavr's own. */
void avr_usart_init(struct avr_usart *usart, avr_t *avr,
                    void (*changed)(void *, avr_cycle_count_t, int8_t), void *param);
void avr_usart_reset(struct avr_usart *usart);

/* Runs to the present cycle; first, until then, without what the last instruction wrote. */
void avr_usart_run(struct avr_usart *usart);

#endif
