// SPDX-License-Identifier: Apache-2.0

/* Counts instructions in QEMU run with -icount shift=0; elsewhere the count is 0. */
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
