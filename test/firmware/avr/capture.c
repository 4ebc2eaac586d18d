// Copyright 2026 tactile_cdma maintainers
//
// Licensed under the Apache License, Version 2.0 (the "License");
// you may not use this file except in compliance with the License.
// You may obtain a copy of the License at
//
//     http://www.apache.org/licenses/LICENSE-2.0
//
// Unless required by applicable law or agreed to in writing, software
// distributed under the License is distributed on an "AS IS" BASIS,
// WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
// See the License for the specific language governing permissions and
// limitations under the License.

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
