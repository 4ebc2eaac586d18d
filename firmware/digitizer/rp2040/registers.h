// SPDX-License-Identifier: Apache-2.0

/* Registers of the RP2040 that the digitizer uses. Registers, and bits that stand for themselves, are named as
 * in pico-sdk 2.2.0 (hardware_structs, hardware_regs); values of fields are named here.
 */
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

struct resets { uint32_t reset, wdsel, reset_done; };
#define RESETS BLOCK(resets, 0x4000c000u)
#define RESETS_RESET_ADC_BITS (1u << 0)
#define RESETS_RESET_DMA_BITS (1u << 2)
#define RESETS_RESET_IO_BANK0_BITS (1u << 5)
#define RESETS_RESET_PADS_BANK0_BITS (1u << 8)
#define RESETS_RESET_PIO0_BITS (1u << 10)
#define RESETS_RESET_PLL_SYS_BITS (1u << 12)
#define RESETS_RESET_PLL_USB_BITS (1u << 13)
#define RESETS_RESET_PWM_BITS (1u << 14)
#define RESETS_RESET_TIMER_BITS (1u << 21)
#define RESETS_RESET_UART0_BITS (1u << 22)
#define RESETS_RESET_USBCTRL_BITS (1u << 24)

/* Resets blocks to their state at power-up. */
static inline void reset_blocks(uint32_t blocks)
{
    set_bits(&RESETS->reset, blocks);
    clear_bits(&RESETS->reset, blocks);
    while (~RESETS->reset_done & blocks)
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
#define XOSC_STATUS_STABLE_BITS (1u << 31)

struct pll { uint32_t cs, pwr, fbdiv_int, prim; };
#define PLL_SYS BLOCK(pll, 0x40028000u)
#define PLL_USB BLOCK(pll, 0x4002c000u)
#define PLL_CS_LOCK_BITS (1u << 31)
#define PLL_PWR_PD_BITS (1u << 0)
#define PLL_PWR_POSTDIVPD_BITS (1u << 3)
#define PLL_PWR_VCOPD_BITS (1u << 5)
#define PLL_PRIM(div1, div2) ((uint32_t)(div1) << 16 | (uint32_t)(div2) << 12)

struct psm { uint32_t frce_on, frce_off, wdsel, done; };
#define PSM BLOCK(psm, 0x40010000u)
#define PSM_ALL_BUT_OSCILLATORS 0x1fffcu

struct watchdog { uint32_t ctrl, load, reason, scratch[8], tick; };
#define WATCHDOG BLOCK(watchdog, 0x40058000u)
#define WATCHDOG_CTRL_ENABLE_BITS (1u << 30)
#define WATCHDOG_PAUSE_DEBUG (7u << 24) /* while a debugger halts a core, as after a reset */
#define WATCHDOG_TICK_ENABLE_BITS (1u << 9)

struct timer {
    uint32_t timehw, timelw, timehr, timelr, alarm[4], armed, timerawh, timerawl;
    uint32_t dbgpause, pause, intr, inte, intf, ints;
};
#define TIMER BLOCK(timer, 0x40054000u)

struct io {
    struct { uint32_t status, ctrl; } io[30];
    uint32_t intr[4], proc0_inte[4];
};
#define IO_BANK0 BLOCK(io, 0x40014000u)
#define IO_QSPI BLOCK(io, 0x40018000u)
#define IO_QSPI_SS 1
#define GPIO_FUNC_UART 2u
#define GPIO_FUNC_PWM 4u
#define GPIO_FUNC_SIO 5u
#define GPIO_FUNC_PIO0 6u
/* Of GPIO16 to 23, in register 2. */
#define IO_BANK0_EDGE_LOW(pin) (1u << (4 * ((pin) - 16) + 2))
#define IO_BANK0_EDGE_HIGH(pin) (1u << (4 * ((pin) - 16) + 3))
#define IO_OUTOVER_LOW (2u << 8)

struct pads { uint32_t voltage_select, io[30]; };
#define PADS_BANK0 BLOCK(pads, 0x4001c000u)
#define PADS_BANK0_GPIO0_PDE_BITS (1u << 2)
#define PADS_BANK0_GPIO0_PUE_BITS (1u << 3)
#define PAD_DRIVE_4MA (1u << 4)
#define PADS_BANK0_GPIO0_SCHMITT_BITS (1u << 1)
#define PADS_BANK0_GPIO0_IE_BITS (1u << 6)
#define PADS_BANK0_GPIO0_OD_BITS (1u << 7)

struct sio {
    uint32_t cpuid, gpio_in, gpio_hi_in, pad, gpio_out, gpio_set, gpio_clr, gpio_togl;
    uint32_t gpio_oe, gpio_oe_set, gpio_oe_clr;
};
#define SIO BLOCK(sio, 0xd0000000u)

struct uart {
    uint32_t dr, rsr, pad[4], fr, pad1, ilpr, ibrd, fbrd, lcr_h, cr, ifls, imsc, ris, mis, icr, dmacr;
};
#define UART0 BLOCK(uart, 0x40034000u)
#define UART_UARTFR_RXFE_BITS (1u << 4)
#define UART_LCR_8N1_FIFO (3u << 5 | 1u << 4)
#define UART_CR_ENABLE (1u << 9 | 1u << 8 | 1u << 0)
#define UART_UARTIMSC_RXIM_BITS (1u << 4)
#define UART_UARTIMSC_RTIM_BITS (1u << 6)
#define UART_UARTDMACR_TXDMAE_BITS (1u << 1)

struct adc { uint32_t cs, result, fcs, fifo, div; };
#define ADC BLOCK(adc, 0x4004c000u)
#define ADC_CS_EN_BITS (1u << 0)
#define ADC_CS_START_ONCE_BITS (1u << 2)
#define ADC_CS_START_MANY_BITS (1u << 3)
#define ADC_CS_READY_BITS (1u << 8)
#define ADC_FCS_EN_BITS (1u << 0)
#define ADC_FCS_DREQ_EN_BITS (1u << 3)
#define ADC_FCS_EMPTY_BITS (1u << 8)
#define ADC_FCS_OVER_BITS (1u << 11)
#define ADC_FCS_THRESH_1 (1u << 24)
#define ADC_CONVERSION 96u /* duration of a conversion, ADC clocks */

struct pwm {
    struct { uint32_t csr, div, ctr, cc, top; } slice[8];
    uint32_t en, intr, inte;
};
#define PWM BLOCK(pwm, 0x40050000u)
#define PWM_CH0_CSR_EN_BITS (1u << 0)
#define PWM_DIV(whole) ((uint32_t)(whole) << 4)

struct dma_channel { uint32_t read_addr, write_addr, transfer_count, ctrl_trig, al1_ctrl, pad[11]; };
#define DMA_CHANNEL(n) (&BLOCK(dma_channel, 0x50000000u)[n])
struct dma_control { uint32_t intr, inte0, intf0, ints0, pad[13], abort; };
#define DMA BLOCK(dma_control, 0x50000400u)
#define DMA_CH0_CTRL_TRIG_EN_BITS (1u << 0)
#define DMA_HALFWORDS (1u << 2)
#define DMA_WORDS (2u << 2)
#define DMA_CH0_CTRL_TRIG_INCR_READ_BITS (1u << 4)
#define DMA_CH0_CTRL_TRIG_INCR_WRITE_BITS (1u << 5)
#define DMA_RING_WRITE(bits) ((uint32_t)(bits) << 6 | 1u << 10)
#define DMA_CHAIN_TO(n) ((uint32_t)(n) << 11)
#define DMA_TREQ(n) ((uint32_t)(n) << 15)
#define DMA_CH0_CTRL_TRIG_IRQ_QUIET_BITS (1u << 21)
#define DMA_CH0_CTRL_TRIG_BUSY_BITS (1u << 24)
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
#define PIO_SM0_SHIFTCTRL_OUT_SHIFTDIR_BITS (1u << 19)
#define PIO_SM0_SHIFTCTRL_AUTOPULL_BITS (1u << 17) /* after 32 bits */
#define PIO_PINCTRL_OUT(base, count) ((uint32_t)(count) << 20 | (uint32_t)(base))

struct ssi {
    uint32_t ctrlr0, ctrlr1, ssienr, mwcr, ser, baudr, txftlr, rxftlr, txflr, rxflr, sr;
    uint32_t pad[13], dr0, pad1[36], spi_ctrlr0;
};
#define SSI BLOCK(ssi, 0x18000000u)
#define SSI_CTRLR0_8_BITS (7u << 16)
#define SSI_SR_RFNE_BITS (1u << 3)

struct usb {
    uint32_t dev_addr_ctrl, int_ep_addr_ctrl[15];
    uint32_t main_ctrl, sof_wr, sof_rd, sie_ctrl, sie_status, int_ep_ctrl, buf_status;
    uint32_t buf_cpu_should_handle, abort, abort_done, ep_stall_arm, nak_poll;
    uint32_t ep_nak_stall_status, muxing, pwr, phy_direct, phy_direct_override, phy_trim, pad;
    uint32_t intr, inte, intf, ints;
};
#define USB BLOCK(usb, 0x50110000u)
#define USB_MAIN_CTRL_CONTROLLER_EN_BITS (1u << 0)
#define USB_SIE_CTRL_EP0_INT_1BUF_BITS (1u << 29)
#define USB_SIE_CTRL_PULLUP_EN_BITS (1u << 16)
#define USB_SIE_STATUS_BUS_RESET_BITS (1u << 19)
#define USB_SIE_STATUS_SETUP_REC_BITS (1u << 17)
#define USB_SIE_STATUS_SUSPENDED_BITS (1u << 4)
#define USB_USB_MUXING_TO_PHY_BITS (1u << 0)
#define USB_USB_MUXING_SOFTCON_BITS (1u << 3)
#define USB_USB_PWR_VBUS_DETECT_BITS (1u << 2)
#define USB_USB_PWR_VBUS_DETECT_OVERRIDE_EN_BITS (1u << 3)
#define USB_INTS_BUFF_STATUS_BITS (1u << 4)
#define USB_INTS_BUS_RESET_BITS (1u << 12)
#define USB_INTS_DEV_SUSPEND_BITS (1u << 14)
#define USB_INTS_SETUP_REQ_BITS (1u << 16)
#define USB_INTS_DEV_SOF_BITS (1u << 17) /* cleared by reading sof_rd */

/* The USB controller's memory: index [0] is IN, [1] is OUT; ep_ctrl[n] belongs to endpoint n + 1. */
struct usb_dpram {
    uint32_t setup_packet[2], ep_ctrl[15][2], ep_buf_ctrl[16][2], ep0_buf_a[16], ep0_buf_b[16], epx_data[];
};
#define USB_DPRAM BLOCK(usb_dpram, 0x50100000u)
#define EP_CTRL_ENABLE_BITS (1u << 31)
#define EP_CTRL_DOUBLE_BUFFERED_BITS (1u << 30)
#define EP_CTRL_INTERRUPT_PER_BUFFER (1u << 29)
#define USB_EP_TYPE(type) ((uint32_t)(type) << 26)
#define USB_BUF_CTRL_FULL (1u << 15)
#define USB_BUF_CTRL_DATA1_PID (1u << 13)
#define USB_BUF_CTRL_SEL (1u << 12) /* buffer 0 is the next */
#define USB_BUF_CTRL_STALL (1u << 11)
#define USB_BUF_CTRL_AVAIL (1u << 10)
#define USB_BUF_CTRL_LEN_MASK 0x3ffu

/* The boot ROM's table of functions, and the one that looks a function up: their addresses. */
extern const volatile uint16_t rom_functions, rom_lookup;

/* Registers of the Cortex-M0+. */
#define NVIC_ISER (*(volatile uint32_t *)0xe000e100u)
#define NVIC_IPR ((volatile uint32_t *)0xe000e400u) /* priorities, of four interrupts in each; 0 is the highest */
#define VTOR (*(volatile uint32_t *)0xe000ed08u)
enum { TIMER_IRQ_0 = 0, PWM_IRQ_WRAP = 4, USBCTRL_IRQ = 5, DMA_IRQ_0 = 11, IO_IRQ_BANK0 = 13, UART0_IRQ = 20 };

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
