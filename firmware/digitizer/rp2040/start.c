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

/* From the second stage to main(): the image goes to RAM, and everything runs there. */
#include <stddef.h>
#include <stdint.h>

#include "registers.h"
#include "rp2040.h"

extern uint32_t image_start[], image_end[], image_load[], bss_start[], bss_end[], stack_top[];
int main(void);

typedef void (*vector)(void);

/* A fault: nothing can be trusted, so the watchdog starts all anew. */
static void hang(void)
{
    for (;;)
        ;
}

static inline size_t words(const uint32_t *begin, const uint32_t *end)
{
    return ((uintptr_t)end - (uintptr_t)begin) / sizeof *begin;
}

__attribute__((section(".flash"), noreturn)) void reset(void)
{
    volatile uint32_t *image = image_start, *bss = bss_start; /* else memcpy is called: in RAM */

    for (size_t i = 0; i < words(image_start, image_end); i++)
        image[i] = image_load[i];
    for (size_t i = 0; i < words(bss_start, bss_end); i++)
        bss[i] = 0;
    VTOR = (uint32_t)image_start;
    main();
    for (;;)
        ;
}

__attribute__((section(".flash_vectors"), used)) static const vector flash_vectors[] = {
    (vector)stack_top,
    reset,
};

__attribute__((section(".vectors"), used)) static const vector vectors[16 + 32] = {
    [0] = (vector)stack_top,
    [1] = reset,
    [2] = hang,
    [3] = hang,
    [16 + IRQ_TIMER_0] = tick_interrupt,
    [16 + IRQ_PWM_WRAP] = sync_interrupt,
    [16 + IRQ_USBCTRL] = usb_interrupt,
    [16 + IRQ_DMA_0] = uart_sent_interrupt,
    [16 + IRQ_UART0] = uart_interrupt,
};
