// SPDX-License-Identifier: Apache-2.0

/* UART0: received bytes by interrupt, sent ones by DMA. */
#include "byte_ring.h"
#include "registers.h"
#include "rp2040.h"

static struct byte_ring received;

void uart_init(void)
{
    IO_BANK0->io[PIN_UART_TX].ctrl = GPIO_FUNC_UART;
    IO_BANK0->io[PIN_UART_RX].ctrl = GPIO_FUNC_UART;
    PADS_BANK0->io[PIN_UART_TX] = PAD_DRIVE_4MA | PADS_BANK0_GPIO0_SCHMITT_BITS;
    PADS_BANK0->io[PIN_UART_RX] = PADS_BANK0_GPIO0_IE_BITS | PADS_BANK0_GPIO0_SCHMITT_BITS |
                                  PADS_BANK0_GPIO0_PUE_BITS | PADS_BANK0_GPIO0_OD_BITS;

    reset_blocks(RESETS_RESET_UART0_BITS);
    UART0->ibrd = 3; /* 96 MHz / (16 · 3) = 2 Mbaud */
    UART0->fbrd = 0;
    UART0->lcr_h = UART_LCR_8N1_FIFO;
    UART0->dmacr = UART_UARTDMACR_TXDMAE_BITS;
    UART0->imsc = UART_UARTIMSC_RXIM_BITS | UART_UARTIMSC_RTIM_BITS;
    UART0->cr = UART_CR_ENABLE;

    DMA->inte0 = 1u << DMA_UART;
    NVIC_ISER = 1u << UART0_IRQ | 1u << DMA_IRQ_0;
}

void uart_interrupt(void)
{
    while (!(UART0->fr & UART_UARTFR_RXFE_BITS)) {
        uint8_t byte = (uint8_t)UART0->dr;
        byte_ring_put(&received, &byte, 1); /* a byte without room: a broken packet, which is counted */
    }
    UART0->icr = UART_UARTIMSC_RTIM_BITS;
    wake();
}

size_t uart_read(uint8_t *bytes, size_t size)
{
    return byte_ring_get(&received, bytes, size);
}

bool uart_ready(void)
{
    return true; /* a UART cannot tell whether a host listens */
}

void uart_send(const uint8_t *bytes, size_t size)
{
    if (!size)
        return;
    DMA_CHANNEL(DMA_UART)->read_addr = (uint32_t)bytes;
    DMA_CHANNEL(DMA_UART)->write_addr = (uint32_t)&UART0->dr;
    DMA_CHANNEL(DMA_UART)->transfer_count = size;
    DMA_CHANNEL(DMA_UART)->ctrl_trig =
        DMA_CH0_CTRL_TRIG_EN_BITS | DMA_CH0_CTRL_TRIG_INCR_READ_BITS |
        DMA_CHAIN_TO(DMA_UART) | DMA_TREQ(DREQ_UART0_TX);
}

bool uart_sending(void)
{
    return DMA_CHANNEL(DMA_UART)->ctrl_trig & DMA_CH0_CTRL_TRIG_BUSY_BITS;
}

size_t uart_cancel(void)
{
    return 0; /* DMA sends the rest in any case */
}

void uart_sent_interrupt(void)
{
    DMA->ints0 = 1u << DMA_UART;
    wake();
}
