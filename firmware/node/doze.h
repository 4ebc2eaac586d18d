// SPDX-License-Identifier: Apache-2.0

/* Sleep that no interrupt can be missed by. */
#ifndef NODE_DOZE_H
#define NODE_DOZE_H

#include <avr/interrupt.h>
#include <avr/sleep.h>

/* Until an interrupt, also one that is waiting already. Interrupts are off before, and on after. */
static inline void doze(void)
{
    sleep_enable();
    sei(); /* takes effect with the instruction after the next */
    sleep_cpu();
    sleep_disable();
}

#endif
