// SPDX-License-Identifier: Apache-2.0

/* The digitizer on an RP2040: everything between its parts and the portable core.
 *
 * Bytes are taken from USB and from the UART. What is sent goes to the one that last sent a good
 * command; before the first one, to USB if a host has configured it, else to the UART.
 */
#include "registers.h"
#include "rp2040.h"

#define TICK_IDLE_US 10000u
#define TICK_STREAMING_US 250u
#define PIECE 4096u /* is sent at a time; only then its room in the output is free again */
#define SAMPLE_CAPACITY TP_MAX_SAMPLES
#define OUTPUT_SIZE 98304u

_Static_assert(OUTPUT_SIZE >= DG_OUTPUT_MIN(SAMPLE_CAPACITY), "the core wants more");

enum link { LINK_NONE, LINK_USB, LINK_UART };

static struct dg_board board = {
    .ticks_per_us = TICKS_PER_US,
    .min_ticks = SAMPLER_MIN_TICKS,
    .max_ticks = SAMPLER_MAX_TICKS,
    .volts_per_count = 3.3f / 4096,
    .zero_count = 2048, /* the amplifier rests at half the supply */
    .min_count = 0,
    .max_count = 4095,
};
static struct dg dg;
static uint8_t output[OUTPUT_SIZE];
static int16_t samples[SAMPLE_CAPACITY];
static volatile bool awake;

static const uint8_t delimiter = 0;
static enum link commander;   /* who sent the last good command */
static enum link heard;       /* whose bytes came last */
static enum link carrier;     /* who sends … */
static size_t in_flight;      /* … so many bytes of the output */

void wake(void)
{
    awake = true;
}

/* Does what the core says after a command: sampling and pulses start anew, or end. */
static void restart(void)
{
    sync_stop();
    sampler_stop();
    tick_every(dg.running ? TICK_STREAMING_US : TICK_IDLE_US);
    if (!dg.running) {
        SIO->out_clr = 1u << PIN_LED;
        return;
    }
    struct moment moment;
    sync_prepare();
    uint32_t begin = sampler_start(dg.ticks_per_sample, &moment);
    dg_begin(&dg, moment.us - (moment.tick + TICKS_PER_US / 2) / TICKS_PER_US);
    sync_start(&dg, begin, &moment);
    SIO->out_set = 1u << PIN_LED;
}

static void hear(enum link link, const uint8_t *bytes, size_t size)
{
    uint64_t now_us = time_us();

    dg_time(&dg, now_us);
    uint16_t next = dg.writer.sequence;
    if (link != heard)
        dg_receive(&dg, &delimiter, 1, now_us); /* two hosts' packets don't mix */
    heard = link;
    dg_receive(&dg, bytes, size, now_us);
    if (dg.writer.sequence != next) /* something was answered */
        commander = link;
    if (dg_restarted(&dg))
        restart();
}

static void receive(void)
{
    uint8_t bytes[128];
    size_t size;

    while ((size = usb_read(bytes, sizeof bytes)))
        hear(LINK_USB, bytes, size);
    while ((size = uart_read(bytes, sizeof bytes)))
        hear(LINK_UART, bytes, size);
}

/* Returns how many there were. */
static size_t pass_samples(void)
{
    const uint16_t *counts;
    uint32_t lost;
    size_t size = sampler_take(&counts, &lost);

    if (lost)
        dg_lost(&dg, lost);
    dg_samples(&dg, counts, size);
    sampler_done(size);
    return size;
}

/* After a pulse that could not be made in time nodes and samples go different ways: a new stream
 * begins. What was sampled until then is sent. */
static void mend(void)
{
    sampler_pause();
    while (pass_samples())
        ;
    dg_end(&dg);
    dg_sync_fault(&dg);
    restart();
}

static void start_sending(const uint8_t *bytes, size_t size)
{
    if (carrier == LINK_USB)
        usb_send(bytes, size);
    else if (size)
        uart_send(bytes, size);
}

static void send(void)
{
    const uint8_t *bytes;
    enum link next = commander ? commander : usb_ready() ? LINK_USB : LINK_UART;

    if (carrier == LINK_USB && next == LINK_UART) { /* a USB host may have stopped reading for good */
        size_t left = usb_cancel();
        in_flight = in_flight > left ? in_flight - left : 0; /* it may have been the delimiter */
    }
    if (carrier == LINK_UART ? uart_sending() : usb_sending())
        return;
    dg_sent(&dg, in_flight);
    in_flight = 0;
    if (carrier != next) {
        carrier = next;
        start_sending(&delimiter, 1); /* ends the packet that was cut when this link was left */
        return;
    }
    if (carrier == LINK_USB && !usb_ready())
        return;
    in_flight = dg_output(&dg, &bytes);
    if (in_flight > PIECE)
        in_flight = PIECE;
    start_sending(bytes, in_flight);
}

int main(void)
{
    clocks_init();
    SIO->oe_set = 1u << PIN_LED;
    IO_BANK0->gpio[PIN_LED].ctrl = IO_SIO;
    PADS_BANK0->gpio[PIN_LED] = PAD_DRIVE_4MA;
    flash_id(board.id);
    sampler_init();
    sync_stop();
    uart_init();
    usb_init(board.id);
    dg_init(&dg, &board, output, sizeof output, samples, SAMPLE_CAPACITY, time_us());
    tick_every(TICK_IDLE_US);

    for (;;) {
        watchdog_feed();
        awake = false;
        receive();
        if (dg.running && sync_failed())
            mend();
        bool more = dg.running && pass_samples() == SAMPLER_CHUNK;
        dg_time(&dg, time_us());
        send();
        interrupts_off();
        if (!awake && !more)
            __asm__ volatile("wfi");
        interrupts_on();
    }
}
