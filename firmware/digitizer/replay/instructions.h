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

/* Counts instructions, where a machine can: QEMU run with -icount shift=0. */
#ifndef REPLAY_INSTRUCTIONS_H
#define REPLAY_INSTRUCTIONS_H

#if defined(__arm__)

#include <stdint.h>

/* Since power-up, in steps of 40: the SysTick timer runs at 25 MHz, an instruction takes 1 ns. */
uint32_t instructions_so_far(void);

#else

#define instructions_so_far() 0u

#endif

#endif
