// SPDX-License-Identifier: Apache-2.0

/* Every state of the output pin, 10 cycles each; released into its pull-up last. */
#include "specimen.h"

int main(void)
{
    LED_DDR |= _BV(LED);
    LED_PORT |= _BV(LED);
    __asm__ volatile("sbi %0, %2\n" /* low */
                     ".rept 8\n nop\n .endr\n"
                     "sbi %1, %2\n" /* high */
                     ".rept 8\n nop\n .endr\n"
                     "cbi %1, %2\n" /* low */
                     ".rept 8\n nop\n .endr\n"
                     "cbi %0, %2\n" /* released */
                     ".rept 8\n nop\n .endr\n"
                     "sbi %1, %2\n" /* pulled up */ ::"I"(_SFR_IO_ADDR(DDRB)),
                     "I"(_SFR_IO_ADDR(PORTB)), "I"(OUT));
    for (;;)
        ;
}
