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

/* Sleep that no interrupt can be missed by. */
#ifndef NODE_DOZE_H
#define NODE_DOZE_H

#include <avr/interrupt.h>
#include <avr/sleep.h>

/* Until an interrupt, also one that is waiting already. Interrupts are off before, and on after. */
static inline void doze(void)
{
    sleep_enable();
    sei(); /* takes effect with the instruction after the next */
    sleep_cpu();
    sleep_disable();
}

#endif
