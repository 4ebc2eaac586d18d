// SPDX-License-Identifier: Apache-2.0

/* Copies the sync line to the output, 201 cycles later, by input capture and output compare. */
#include "specimen.h"

ISR(TIMER1_CAPT_vect)
{
    OCR1A = ICR1 + 200;
    TCCR1A = TCCR1B & _BV(ICES1) ? _BV(COM1A1) | _BV(COM1A0) : _BV(COM1A1);
    TCCR1B ^= _BV(ICES1);
}

int main(void)
{
    DDRB = _BV(OUT);
    listen();
#ifdef AWAKE
    sei();
    for (;;)
        __asm__ volatile("call 0f\n0: pop r0\n pop r0"); /* instructions of up to 4 cycles */
#else
    sleep_on();
#endif
}
