// SPDX-License-Identifier: Apache-2.0

/* An interrupt makes a pulse, with its first instructions. */
#include "specimen.h"

ISR(SYNC_VECTOR, ISR_NAKED)
{
    __asm__ volatile("sbi %0, %1\n cbi %0, %1\n reti" ::"I"(_SFR_IO_ADDR(PORTB)), "I"(OUT));
}

int main(void)
{
    DDRB = _BV(OUT);
    listen();
    sleep_on();
}
