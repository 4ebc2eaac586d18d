// SPDX-License-Identifier: Apache-2.0

/* At every sync pulse shows what the converter reads. */
#include "specimen.h"

int main(void)
{
    DDRB = _BV(OUT);
#if defined(__AVR_ATtiny85__)
    ADMUX = SENSOR; /* reference Vcc */
#else
    ADMUX = _BV(REFS0) | SENSOR; /* reference AVcc */
#endif
    ADCSRA = _BV(ADEN) | _BV(ADPS2) | _BV(ADPS1);
    for (;;) {
        wait_for_sync();
        ADCSRA |= _BV(ADSC);
        loop_until_bit_is_clear(ADCSRA, ADSC);
        show(ADC);
    }
}
