// SPDX-License-Identifier: Apache-2.0

/* Start-up after the second boot stage: copies the image to RAM and runs main() there. */
#include <stddef.h>
#include <stdint.h>

#include "registers.h"
#include "rp2040.h"

extern uint32_t image_start[], image_end[], image_load[], bss_start[], bss_end[], stack_top[];
int main(void);

typedef void (*vector)(void);

/* A fault: waits for the watchdog to reset the chip. */
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
    /* volatile: else the compiler calls memcpy, which is not in RAM yet */
    volatile uint32_t *image = image_start, *bss = bss_start;

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
    [16 + TIMER_IRQ_0] = tick_interrupt,
    [16 + PWM_IRQ_WRAP] = sync_interrupt,
    [16 + USBCTRL_IRQ] = usb_interrupt,
    [16 + DMA_IRQ_0] = uart_sent_interrupt,
    [16 + IO_IRQ_BANK0] = hear_interrupt,
    [16 + UART0_IRQ] = uart_interrupt,
};
