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
