// SPDX-License-Identifier: Apache-2.0

/* A pulse if an interrupt flag clears alone; another at once if one that is set interrupts when it
 * is enabled. */
#include "specimen.h"

ISR(TIMER1_COMPB_vect)
{
    show(1);
}

int main(void)
{
    DDRB = _BV(OUT);
    OCR1A = 100;
    OCR1B = 100;
    listen();
    TIMER1_MASK = 0;
    loop_until_bit_is_set(TIMER1_FLAGS, OCF1A);
    TIMER1_FLAGS = _BV(OCF1A);
    if (!(TIMER1_FLAGS & _BV(OCF1A)) && TIMER1_FLAGS & _BV(OCF1B))
        show(1);
    TIMER1_MASK = _BV(OCIE1B);
    sleep_on();
}
