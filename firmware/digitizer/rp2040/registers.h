// SPDX-License-Identifier: Apache-2.0

/* Registers of the RP2040 that the digitizer uses, named as in its data sheet. */
#ifndef RP2040_REGISTERS_H
#define RP2040_REGISTERS_H

#include <stdint.h>

#define BLOCK(type, address) ((volatile struct type *)(address))

/* Aliases of a peripheral's registers that set or clear the bits written as 1. */
static inline void set_bits(volatile uint32_t *reg, uint32_t bits)
{
    *(volatile uint32_t *)((uintptr_t)reg | 0x2000u) = bits;
}

static inline void clear_bits(volatile uint32_t *reg, uint32_t bits)
{
    *(volatile uint32_t *)((uintptr_t)reg | 0x3000u) = bits;
}

struct resets { uint32_t reset, wdsel, done; };
#define RESETS BLOCK(resets, 0x4000c000u)
#define RESET_ADC (1u << 0)
#define RESET_DMA (1u << 2)
#define RESET_IO_BANK0 (1u << 5)
#define RESET_PADS_BANK0 (1u << 8)
#define RESET_PIO0 (1u << 10)
#define RESET_PLL_SYS (1u << 12)
#define RESET_PLL_USB (1u << 13)
#define RESET_PWM (1u << 14)
#define RESET_TIMER (1u << 21)
#define RESET_UART0 (1u << 22)
#define RESET_USBCTRL (1u << 24)

/* Resets blocks to their state at power-up. */
static inline void reset_blocks(uint32_t blocks)
{
    set_bits(&RESETS->reset, blocks);
    clear_bits(&RESETS->reset, blocks);
    while (~RESETS->done & blocks)
        ;
}

struct clock { uint32_t ctrl, div, selected; };
#define CLK_REF BLOCK(clock, 0x40008030u)
#define CLK_SYS BLOCK(clock, 0x4000803cu)
#define CLK_PERI BLOCK(clock, 0x40008048u)
#define CLK_USB BLOCK(clock, 0x40008054u)
#define CLK_ADC BLOCK(clock, 0x40008060u)
#define CLK_REF_XOSC 2u
#define CLK_SYS_AUX 1u  /* PLL_SYS by default */
#define CLK_ENABLE (1u << 11)
#define CLK_DIV_1 (1u << 8)

struct xosc { uint32_t ctrl, status, dormant, startup; };
#define XOSC BLOCK(xosc, 0x40024000u)
#define XOSC_ENABLE_1_15MHZ 0xfabaa0u
#define XOSC_STABLE (1u << 31)

struct pll { uint32_t cs, pwr, fbdiv, prim; };
#define PLL_SYS BLOCK(pll, 0x40028000u)
#define PLL_USB BLOCK(pll, 0x4002c000u)
#define PLL_LOCK (1u << 31)
#define PLL_PWR_PD (1u << 0)
#define PLL_PWR_POSTDIVPD (1u << 3)
#define PLL_PWR_VCOPD (1u << 5)
#define PLL_PRIM(div1, div2) ((uint32_t)(div1) << 16 | (uint32_t)(div2) << 12)

struct psm { uint32_t frce_on, frce_off, wdsel, done; };
#define PSM BLOCK(psm, 0x40010000u)
#define PSM_ALL_BUT_OSCILLATORS 0x1fffcu

struct watchdog { uint32_t ctrl, load, reason, scratch[8], tick; };
#define WATCHDOG BLOCK(watchdog, 0x40058000u)
#define WATCHDOG_ENABLE (1u << 30)
#define WATCHDOG_PAUSE_DEBUG (7u << 24) /* while a debugger halts a core, as after a reset */
#define WATCHDOG_TICK_ENABLE (1u << 9)

struct timer {
    uint32_t timehw, timelw, timehr, timelr, alarm[4], armed, timerawh, timerawl;
    uint32_t dbgpause, pause, intr, inte, intf, ints;
};
#define TIMER BLOCK(timer, 0x40054000u)

struct io { struct { uint32_t status, ctrl; } gpio[30]; };
#define IO_BANK0 BLOCK(io, 0x40014000u)
#define IO_QSPI BLOCK(io, 0x40018000u)
#define IO_QSPI_SS 1
#define IO_UART 2u
#define IO_PWM 4u
#define IO_SIO 5u
#define IO_PIO0 6u
#define IO_OUTOVER_LOW (2u << 8)

struct pads { uint32_t voltage_select, gpio[30]; };
#define PADS_BANK0 BLOCK(pads, 0x4001c000u)
#define PAD_PULL_DOWN (1u << 2)
#define PAD_PULL_UP (1u << 3)
#define PAD_DRIVE_4MA (1u << 4)
#define PAD_SCHMITT (1u << 1)
#define PAD_INPUT (1u << 6)
#define PAD_NO_OUTPUT (1u << 7)

struct sio { uint32_t cpuid, in, hi_in, pad, out, out_set, out_clr, out_xor, oe, oe_set, oe_clr; };
#define SIO BLOCK(sio, 0xd0000000u)

struct uart {
    uint32_t dr, rsr, pad[4], fr, pad1, ilpr, ibrd, fbrd, lcr_h, cr, ifls, imsc, ris, mis, icr, dmacr;
};
#define UART0 BLOCK(uart, 0x40034000u)
#define UART_FR_RXFE (1u << 4)
#define UART_LCR_8N1_FIFO (3u << 5 | 1u << 4)
#define UART_CR_ENABLE (1u << 9 | 1u << 8 | 1u << 0)
#define UART_INT_RX (1u << 4)
#define UART_INT_RX_TIMEOUT (1u << 6)
#define UART_DMA_TX (1u << 1)

struct adc { uint32_t cs, result, fcs, fifo, div; };
#define ADC BLOCK(adc, 0x4004c000u)
#define ADC_CS_EN (1u << 0)
#define ADC_CS_START_ONCE (1u << 2)
#define ADC_CS_START_MANY (1u << 3)
#define ADC_CS_READY (1u << 8)
#define ADC_FCS_EN (1u << 0)
#define ADC_FCS_DREQ (1u << 3)
#define ADC_FCS_EMPTY (1u << 8)
#define ADC_FCS_OVER (1u << 11)
#define ADC_FCS_THRESH_1 (1u << 24)
#define ADC_CONVERSION 96u /* duration of a conversion, ADC clocks */

struct pwm {
    struct { uint32_t csr, div, ctr, cc, top; } slice[8];
    uint32_t en, intr, inte;
};
#define PWM BLOCK(pwm, 0x40050000u)
#define PWM_CSR_EN (1u << 0)
#define PWM_DIV(whole) ((uint32_t)(whole) << 4)

struct dma_channel { uint32_t read_addr, write_addr, trans_count, ctrl_trig, al1_ctrl, pad[11]; };
#define DMA_CHANNEL(n) (&BLOCK(dma_channel, 0x50000000u)[n])
struct dma_control { uint32_t intr, inte0, intf0, ints0, pad[13], chan_abort; };
#define DMA BLOCK(dma_control, 0x50000400u)
#define DMA_EN (1u << 0)
#define DMA_HALFWORDS (1u << 2)
#define DMA_WORDS (2u << 2)
#define DMA_INCR_READ (1u << 4)
#define DMA_INCR_WRITE (1u << 5)
#define DMA_RING_WRITE(bits) ((uint32_t)(bits) << 6 | 1u << 10)
#define DMA_CHAIN_TO(n) ((uint32_t)(n) << 11)
#define DMA_TREQ(n) ((uint32_t)(n) << 15)
#define DMA_QUIET (1u << 21)
#define DMA_BUSY (1u << 24)
#define DREQ_PIO0_TX0 0
#define DREQ_UART0_TX 20
#define DREQ_ADC 36

struct pio {
    uint32_t ctrl, fstat, fdebug, flevel, txf[4], rxf[4], irq, irq_force, input_sync_bypass;
    uint32_t dbg_padout, dbg_padoe, dbg_cfginfo, instr_mem[32];
    struct { uint32_t clkdiv, execctrl, shiftctrl, addr, instr, pinctrl; } sm[4];
};
#define PIO0 BLOCK(pio, 0x50200000u)
#define PIO_CTRL_SM0_ENABLE (1u << 0)
#define PIO_FDEBUG_TXSTALL_SM0 (1u << 24)
#define PIO_EXECCTRL_WRAP(bottom, top) ((uint32_t)(top) << 12 | (uint32_t)(bottom) << 7)
#define PIO_SHIFTCTRL_OUT_RIGHT (1u << 19)
#define PIO_SHIFTCTRL_AUTOPULL (1u << 17) /* after 32 bits */
#define PIO_PINCTRL_OUT(base, count) ((uint32_t)(count) << 20 | (uint32_t)(base))

struct ssi {
    uint32_t ctrlr0, ctrlr1, ssienr, mwcr, ser, baudr, txftlr, rxftlr, txflr, rxflr, sr;
    uint32_t pad[13], dr0, pad1[36], spi_ctrlr0;
};
#define SSI BLOCK(ssi, 0x18000000u)
#define SSI_CTRLR0_8_BITS (7u << 16)
#define SSI_SR_RFNE (1u << 3)

struct usb {
    uint32_t addr_endp[16], main_ctrl, sof_wr, sof_rd, sie_ctrl, sie_status, int_ep_ctrl, buff_status;
    uint32_t buff_cpu_should_handle, ep_abort, ep_abort_done, ep_stall_arm, nak_poll;
    uint32_t ep_status_stall_nak, muxing, pwr, phy_direct, phy_direct_override, phy_trim, pad;
    uint32_t intr, inte, intf, ints;
};
#define USB BLOCK(usb, 0x50110000u)
#define USB_MAIN_CTRL_EN (1u << 0)
#define USB_SIE_CTRL_EP0_INT_1BUF (1u << 29)
#define USB_SIE_CTRL_PULLUP_EN (1u << 16)
#define USB_SIE_STATUS_BUS_RESET (1u << 19)
#define USB_SIE_STATUS_SETUP_REC (1u << 17)
#define USB_SIE_STATUS_SUSPENDED (1u << 4)
#define USB_MUXING_TO_PHY (1u << 0)
#define USB_MUXING_SOFTCON (1u << 3)
#define USB_PWR_VBUS_DETECT (1u << 2)
#define USB_PWR_VBUS_DETECT_OVERRIDE (1u << 3)
#define USB_INT_BUFF_STATUS (1u << 4)
#define USB_INT_BUS_RESET (1u << 12)
#define USB_INT_DEV_SUSPEND (1u << 14)
#define USB_INT_SETUP_REQ (1u << 16)
#define USB_INT_DEV_SOF (1u << 17) /* cleared by reading sof_rd */

/* The USB controller's memory: index [0] is IN, [1] is OUT; ep_ctrl[n] belongs to endpoint n + 1. */
struct usb_dpram {
    uint32_t setup[2], ep_ctrl[15][2], buf_ctrl[16][2], ep0[16], ep0_second[16], data[];
};
#define USB_DPRAM BLOCK(usb_dpram, 0x50100000u)
#define USB_EP_ENABLE (1u << 31)
#define USB_EP_DOUBLE_BUFFERED (1u << 30)
#define USB_EP_INT_PER_BUFFER (1u << 29)
#define USB_EP_TYPE(type) ((uint32_t)(type) << 26)
#define USB_BUF_FULL (1u << 15)
#define USB_BUF_DATA1 (1u << 13)
#define USB_BUF_RESET (1u << 12) /* buffer 0 is the next */
#define USB_BUF_STALL (1u << 11)
#define USB_BUF_AVAILABLE (1u << 10)
#define USB_BUF_LENGTH 0x3ffu

/* The boot ROM's table of functions, and the one that looks a function up: their addresses. */
extern const volatile uint16_t rom_functions, rom_lookup;

/* Registers of the Cortex-M0+. */
#define NVIC_ISER (*(volatile uint32_t *)0xe000e100u)
#define VTOR (*(volatile uint32_t *)0xe000ed08u)
enum { IRQ_TIMER_0 = 0, IRQ_PWM_WRAP = 4, IRQ_USBCTRL = 5, IRQ_DMA_0 = 11, IRQ_UART0 = 20 };

static inline void interrupts_off(void)
{
    __asm__ volatile("cpsid i" ::: "memory");
}

static inline void interrupts_on(void)
{
    __asm__ volatile("cpsie i" ::: "memory");
}

_Static_assert(sizeof(struct timer) == 0x44, "struct timer");
_Static_assert(sizeof(struct uart) == 0x4c, "struct uart");
_Static_assert(sizeof(struct dma_channel) == 0x40, "struct dma_channel");
_Static_assert(sizeof(struct dma_control) == 0x48, "struct dma_control");
_Static_assert(sizeof(struct pio) == 0x128, "struct pio");
_Static_assert(sizeof(struct pwm) == 0xac, "struct pwm");
_Static_assert(sizeof(struct ssi) == 0xf8, "struct ssi");
_Static_assert(sizeof(struct usb) == 0x9c, "struct usb");
_Static_assert(sizeof(struct usb_dpram) == 0x180, "struct usb_dpram");
_Static_assert(sizeof(struct watchdog) == 0x30, "struct watchdog");

#endif
