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
