// SPDX-License-Identifier: Apache-2.0

/* Output compare A: forced, toggled by matches every 400 cycles, disconnected, and set for good. */
#include "specimen.h"

static uint16_t matches;

ISR(TIMER1_COMPA_vect)
{
    OCR1A += STEP;
    if (++matches == 9)
        MODE(NONE); /* the PORT bit, which is low */
    if (matches == 10)
        MODE(SET); /* from now on it stays high */
}

int main(void)
{
    listen();
    TIMER1_MASK = _BV(OCIE1A);
    MODE(SET);
    FORCE(); /* while released */
    DDRB = _BV(OUT);
    MODE(CLEAR);
    FORCE();
    MODE(SET); /* nothing yet */
    MODE(TOGGLE);
    OCR1A = 200;
    TIMER1_FLAGS = _BV(OCF1A);
    sleep_on();
}
