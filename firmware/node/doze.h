// SPDX-License-Identifier: Apache-2.0

/* Sleeps without missing an interrupt. */
#ifndef NODE_DOZE_H
#define NODE_DOZE_H

#include <avr/interrupt.h>
#include <avr/sleep.h>

/* Sleeps until an interrupt; returns at once if one is pending. Turns interrupts, off before, on. */
static inline void doze(void)
{
    sleep_enable();
    sei(); /* takes effect with the instruction after the next */
    sleep_cpu();
    sleep_disable();
}

#endif
