// SPDX-License-Identifier: Apache-2.0

/* Clears the sync line's flag at each of CLEARED edges, before it interrupts. A pulse at each interrupt
 * after that: there should be one, of Timer1. */
#include "specimen.h"

#if defined(__AVR_ATtiny85__)
#define SYNC_FLAGS GIFR
#define SYNC_FLAG INTF0
#else
#define SYNC_FLAGS TIFR1
#define SYNC_FLAG ICF1
#endif

ISR(SYNC_VECTOR)
{
    show(1);
}

ISR(TIMER1_COMPB_vect)
{
    TIMER1_MASK = 0;
    show(1);
}

int main(void)
{
    DDRB = _BV(OUT);
    OCR1B = 100;
    listen();
    for (uint8_t i = 0; i < CLEARED; i++) {
        loop_until_bit_is_set(SYNC_FLAGS, SYNC_FLAG);
        SYNC_FLAGS = _BV(SYNC_FLAG);
    }
    TIMER1_MASK |= _BV(OCIE1B);
    sleep_on();
}
