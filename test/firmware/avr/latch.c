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
