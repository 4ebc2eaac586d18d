// SPDX-License-Identifier: Apache-2.0

/* Samples the ADC into RAM without the CPU: the converter runs freely, and two DMA channels, each of
 * which starts the other when it ends, write its results into one ring.
 */
#include "registers.h"
#include "rp2040.h"

#include <string.h>

#define RING_BITS 15 /* 2¹⁵ bytes: the longest ring that DMA can wrap */
#define RING_SIZE (1u << RING_BITS >> 1)
/* Samples that may wait. Older ones could be overwritten while they are copied; the quarter is chosen. */
#define KEPT (RING_SIZE - RING_SIZE / 4)

/* Samples per turn of a DMA channel: a multiple of the ring, so that each channel begins where the
 * other ended. The writer's position is known modulo two turns, which last 1.05 s at 500 kS/s: longer
 * than the watchdog lets the reader pause. */
#define TURN (1u << 18)
#define POSITION (2 * TURN - 1)

/* Ticks from the end of the first conversion to the PWM's start: the result enters the FIFO, the CPU
 * sees it and writes one register. Estimated from these cycles; no board has been measured. */
#define START_TICKS 7u

__attribute__((section(".ring"), aligned(1u << RING_BITS))) static uint16_t ring[RING_SIZE];
static uint16_t chunk[DG_CHUNK]; /* samples being packed: in the ring the next lap may overwrite them */
static struct moment begin;
static uint32_t ticks_per_sample;
static uint32_t read_position;
static bool overflowed;  /* the FIFO has, and the loss is not yet counted */
static uint32_t skipped; /* conversions whose results never reached the ring */

void sampler_init(void)
{
    PADS_BANK0->io[PIN_LINE] = PADS_BANK0_GPIO0_OD_BITS;
}

uint32_t sampler_start(uint32_t ticks, struct moment *moment)
{
    const uint32_t channel = DMA_CH0_CTRL_TRIG_EN_BITS | DMA_HALFWORDS |
                             DMA_CH0_CTRL_TRIG_INCR_WRITE_BITS | DMA_RING_WRITE(RING_BITS) |
                             DMA_TREQ(DREQ_ADC) | DMA_CH0_CTRL_TRIG_IRQ_QUIET_BITS;

    reset_blocks(RESETS_RESET_ADC_BITS);
    ADC->cs = ADC_CS_EN_BITS;
    while (!(ADC->cs & ADC_CS_READY_BITS))
        ;
    ADC->fcs = ADC_FCS_EN_BITS | ADC_FCS_THRESH_1;
    for (int n = DMA_SAMPLES_A; n <= DMA_SAMPLES_B; n++) {
        DMA_CHANNEL(n)->read_addr = (uint32_t)&ADC->fifo;
        DMA_CHANNEL(n)->write_addr = (uint32_t)ring;
        DMA_CHANNEL(n)->transfer_count = TURN;
    }
    DMA_CHANNEL(DMA_SAMPLES_B)->al1_ctrl = channel | DMA_CHAIN_TO(DMA_SAMPLES_A);
    DMA_CHANNEL(DMA_SAMPLES_A)->ctrl_trig = channel | DMA_CHAIN_TO(DMA_SAMPLES_B);

    /* The PWM starts when the first result is seen: so the start of its conversion is known, however
     * long the ADC took to start. */
    interrupts_off();
    ADC->div = (ticks - 1) << 8; /* now: this restarts the divider */
    ADC->cs = ADC_CS_EN_BITS | ADC_CS_START_MANY_BITS;
    while (ADC->fcs & ADC_FCS_EMPTY_BITS)
        ;
    PWM->slice[0].csr = PWM_CH0_CSR_EN_BITS;
    /* at once: the FIFO holds only 4 results */
    ADC->fcs = ADC_FCS_EN_BITS | ADC_FCS_THRESH_1 | ADC_FCS_DREQ_EN_BITS;
    uint32_t us = TIMER->timerawl;
    while (TIMER->timerawl == us)
        ;
    uint32_t counted = PWM->slice[0].ctr;
    moment->us = time_us();
    interrupts_on();

    /* a sample is taken in the middle of its period: the first one half a period after tick 0 */
    uint32_t pwm_tick = ticks / 2 + ADC_CONVERSION + START_TICKS;
    moment->tick = pwm_tick + counted;
    begin = *moment;
    ticks_per_sample = ticks;
    read_position = skipped = 0;
    overflowed = false;
    return pwm_tick;
}

void sampler_pause(void)
{
    ADC->cs = ADC_CS_EN_BITS;
}

void sampler_stop(void)
{
    reset_blocks(RESETS_RESET_ADC_BITS);
    DMA_CHANNEL(DMA_SAMPLES_A)->al1_ctrl = 0; /* else the end of one starts the other */
    DMA_CHANNEL(DMA_SAMPLES_B)->al1_ctrl = 0;
    DMA->abort = 1u << DMA_SAMPLES_A | 1u << DMA_SAMPLES_B;
    while (DMA->abort)
        ;
}

/* Samples written by DMA, modulo two turns. Between turns, neither channel is busy for some clocks. */
static uint32_t position(void)
{
    for (;;) {
        if (DMA_CHANNEL(DMA_SAMPLES_A)->ctrl_trig & DMA_CH0_CTRL_TRIG_BUSY_BITS)
            return TURN - DMA_CHANNEL(DMA_SAMPLES_A)->transfer_count;
        if (DMA_CHANNEL(DMA_SAMPLES_B)->ctrl_trig & DMA_CH0_CTRL_TRIG_BUSY_BITS)
            return (2 * TURN - DMA_CHANNEL(DMA_SAMPLES_B)->transfer_count) & POSITION;
    }
}

/* After an overflow of the FIFO: derives the number of missing results from the time. Their positions
 * are unknown, so all samples since the last look count as lost. Returns their number; 0 while the
 * FIFO is not empty. */
static uint32_t count_lost(void)
{
    uint32_t us, written, rest;
    uint64_t ticks;
    bool drained;

    do { /* until the time, known to 1 µs, is clear of a conversion's end */
        interrupts_off();
        us = TIMER->timerawl;
        while (TIMER->timerawl == us)
            ;
        drained = ADC->fcs & ADC_FCS_EMPTY_BITS; /* before the position, else that may lack the last */
        written = position();
        ticks = (time_us() - begin.us) * TICKS_PER_US + begin.tick;
        interrupts_on();
        ticks = ticks - ADC_CONVERSION - ticks_per_sample / 2 + ticks_per_sample;
        rest = (uint32_t)(ticks % ticks_per_sample);
    } while (rest < ADC_CONVERSION / 4 || rest > ticks_per_sample - ADC_CONVERSION / 4);
    if (!drained)
        return 0;

    uint32_t converted = (uint32_t)(ticks / ticks_per_sample);
    uint32_t missing = (converted - written - skipped) & POSITION;
    uint32_t lost = missing + ((written - read_position) & POSITION);
    skipped += missing;
    read_position = written;
    return lost;
}

size_t sampler_take(const uint16_t **samples, uint32_t *lost)
{
    uint32_t written = position();

    *lost = 0;
    if (ADC->fcs & ADC_FCS_OVER_BITS) { /* read after the position: everything before that is intact */
        ADC->fcs = ADC_FCS_EN_BITS | ADC_FCS_THRESH_1 | ADC_FCS_DREQ_EN_BITS | ADC_FCS_OVER_BITS;
        overflowed = true;
    }
    if (overflowed) {
        *lost = count_lost();
        overflowed = *lost == 0;
        return 0;
    }
    uint32_t waiting = (written - read_position) & POSITION;
    if (waiting > KEPT) {
        *lost = waiting - KEPT;
        sampler_done(*lost);
        waiting = KEPT;
    }
    uint32_t place = read_position % RING_SIZE;
    if (waiting > RING_SIZE - place)
        waiting = RING_SIZE - place;
    if (waiting > DG_CHUNK)
        waiting = DG_CHUNK;
    memcpy(chunk, ring + place, waiting * sizeof chunk[0]);
    *samples = chunk;
    if (((position() - read_position) & POSITION) < RING_SIZE)
        return waiting;
    *lost += waiting; /* the next lap has begun where they were */
    sampler_done(waiting);
    return 0;
}

void sampler_done(size_t size)
{
    read_position = (read_position + size) & POSITION;
}
