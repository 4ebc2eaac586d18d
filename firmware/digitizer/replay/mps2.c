// SPDX-License-Identifier: Apache-2.0

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
