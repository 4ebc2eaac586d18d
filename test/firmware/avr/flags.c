/* Interrupt flags: a pulse of 1 unit if one clears alone, then one if a set flag interrupts once enabled. */
#include "specimen.h"

#if defined(__AVR_ATtiny85__)
#define FLAGS TIFR
#else
#define FLAGS TIFR1
#endif

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
    loop_until_bit_is_set(FLAGS, OCF1A);
    FLAGS = _BV(OCF1A);
    if (!(FLAGS & _BV(OCF1A)) && FLAGS & _BV(OCF1B))
        show(1);
    TIMER1_MASK = _BV(OCIE1B);
    sleep_on();
}
