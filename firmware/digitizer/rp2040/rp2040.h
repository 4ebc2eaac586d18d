// SPDX-License-Identifier: Apache-2.0

/* The parts of this board, each in the source file of its name.
 *
 * Interrupts move bytes and set up pulses; main() does the rest and sleeps until one of them wakes it.
 */
#ifndef RP2040_H
#define RP2040_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "digitizer.h"

#define TICKS_PER_US 48u /* of the ADC's clock, and of the PWM's */

enum pin {
    PIN_UART_TX = 0,
    PIN_UART_RX = 1,
    PIN_SYNC = 16,
    PIN_HEARD = 17, /* sync line of another digitizer */
    PIN_FEEDS = 22, /* beside a ground pin of a Pico */
    PIN_LED = 25, /* of a Pico W: its radio's chip select; the radio stays off, as GPIO23 stays low */
    PIN_LINE = 26,
};
enum dma { DMA_SAMPLES_A, DMA_SAMPLES_B, DMA_UART, DMA_PINS };

/* clocks: crystal, PLLs, watchdog, time, and the tick that wakes main() */
void clocks_init(void);
void watchdog_feed(void);
uint64_t time_us(void);
/* Wakes main() every `us` µs. */
void tick_every(uint32_t us);
void tick_interrupt(void);

/* A moment on two clocks: ticks of the stream, and µs since power-up. */
struct moment {
    uint32_t tick;
    uint64_t us;
};

/* sampler: ADC through DMA into a ring in RAM. take, done and pause are those of struct dg_hardware. */
#define SAMPLER_MIN_TICKS 96u
#define SAMPLER_MAX_TICKS 65536u
void sampler_init(void);
/* Starts sampling and the PWM, which sync_prepare has set up. Returns the stream's tick at which the
 * PWM began to count; sets *moment to a moment shortly after. */
uint32_t sampler_start(uint32_t ticks_per_sample, struct moment *moment);
void sampler_pause(void);
void sampler_stop(void);
size_t sampler_take(const uint16_t **samples, uint32_t *lost);
void sampler_done(size_t size);

/* sync: pulses on the sync line, placed exactly by the PWM */
void sync_prepare(void);
/* Starts making the pulses of dg. begin: the tick at which the PWM began to count. */
void sync_start(struct dg *dg, uint32_t begin, const struct moment *moment);
void sync_stop(void);
/* A pulse could not be made in time; pulses have stopped. */
bool sync_failed(void);
void sync_interrupt(void);

/* hear: tells dg of frames on the sync line of another digitizer, if it is set to hear them */
void hear_init(struct dg *dg);
void hear_interrupt(void);

/* uart: UART0, 2 Mbaud, 8N1. From here on to usb_cancel, functions are those of struct dg_link. */
void uart_init(void);
bool uart_ready(void);
size_t uart_read(uint8_t *bytes, size_t size);
void uart_send(const uint8_t *bytes, size_t size);
bool uart_sending(void);
size_t uart_cancel(void);
void uart_interrupt(void);
void uart_sent_interrupt(void);

/* usb: a CDC ACM device */
void usb_init(const uint8_t id[8], uint32_t current_ma);
size_t usb_read(uint8_t *bytes, size_t size);
/* Size 0 sends an empty packet, if needed: it tells the host's driver that nothing follows for now. */
void usb_send(const uint8_t *bytes, size_t size);
bool usb_sending(void);
/* A packet that the controller already has stays there. */
size_t usb_cancel(void);
/* A host has configured the device and is awake, and a program has opened the port. */
bool usb_ready(void);
void usb_interrupt(void);

/* flash_id: the flash's unique number; zeros where it has none */
void flash_id(uint8_t id[8]);

/* bootsel: restarts the board as a USB drive, soon after that was asked for */
void bootsel_ask(void);
void bootsel_when_asked(void);

/* main: wakes main(), because an interrupt has left it work */
void wake(void);

#endif
