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
