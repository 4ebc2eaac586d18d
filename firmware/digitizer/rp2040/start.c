/* From the second stage to main(): the image goes to RAM, and everything runs there. */
#include <stdint.h>

#include "rp2040.h"
#include "registers.h"

extern uint32_t image_start[], image_end[], image_load[], bss_start[], bss_end[], stack_top[];
int main(void);

typedef void (*vector)(void);

/* A fault: nothing can be trusted, so the watchdog starts all anew. */
static void hang(void)
{
    for (;;)
        ;
}

/* volatile: else the compiler calls memcpy, which is not there yet */
__attribute__((section(".flash"), noreturn)) void reset(void)
{
    const uint32_t *from = image_load;
    for (volatile uint32_t *to = image_start; to < image_end;)
        *to++ = *from++;
    for (volatile uint32_t *to = bss_start; to < bss_end;)
        *to++ = 0;
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
