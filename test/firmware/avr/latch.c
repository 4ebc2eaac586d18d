/* Output compare A: forced, and matched every 400 cycles; the timer overflows on. */
#include "specimen.h"

#if defined(__AVR_ATtiny85__)
#define MODE(mode) TCCR1 = (uint8_t)(_BV(CS11) | (mode) << COM1A0)
#define FORCE() GTCCR = _BV(FOC1A)
#define FLAGS TIFR
#define STEP 200
#else
#define MODE(mode) TCCR1A = (uint8_t)((mode) << COM1A0)
#define FORCE() TCCR1C = _BV(FOC1A)
#define FLAGS TIFR1
#define STEP 400
#endif
enum { TOGGLE = 1, CLEAR, SET };

static uint8_t matches;

ISR(TIMER1_COMPA_vect)
{
    OCR1A += STEP;
    if (++matches == 10)
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
    FLAGS = _BV(OCF1A);
    sleep_on();
}
