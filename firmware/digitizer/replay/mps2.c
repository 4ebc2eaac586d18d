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

/* Start-up for QEMU's mps2-an385. newlib's semihosting does the rest: arguments, files, exit. */
#include <stdint.h>

#include "instructions.h"

extern uint32_t stack_top;
void _start(void); /* newlib's */

__attribute__((section(".vectors"), used)) static const void *const vectors[] = {
    &stack_top,
    _start,
};

struct systick {
    volatile uint32_t control, reload, value;
};

#define SYSTICK ((struct systick *)0xE000E010u)
#define SYSTICK_ON 5u /* counts down with the processor's clock, no interrupt */
#define SYSTICK_BITS 24
#define NS_PER_TICK 40u

uint32_t instructions_so_far(void)
{
    static uint32_t last, ticks;

    if (SYSTICK->control == 0) {
        SYSTICK->reload = last = (1u << SYSTICK_BITS) - 1;
        SYSTICK->value = 0;
        SYSTICK->control = SYSTICK_ON;
    }
    uint32_t now = SYSTICK->value;
    ticks += (last - now) & ((1u << SYSTICK_BITS) - 1);
    last = now;
    return ticks * NS_PER_TICK;
}
