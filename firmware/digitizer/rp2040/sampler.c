// SPDX-License-Identifier: Apache-2.0

/* ADC to RAM without the CPU: the converter runs by itself, and two DMA channels take turns to write
 * its results into one ring; each hands over to the other for ever.
 */
#include "registers.h"
#include "rp2040.h"

#define RING_BITS 15 /* of bytes: the longest ring that DMA can wrap */
#define RING_SIZE (1u << RING_BITS >> 1)
#define KEPT (RING_SIZE - RING_SIZE / 4) /* what is older may be written over while it is read */

/* Samples per turn of a DMA channel. A multiple of the ring, so that each channel begins where the
 * other ended. Of the writer's position, two turns are known: at 500 kS/s they last 1.05 s, longer
 * than the watchdog lets the reader be away. */
#define TURN (1u << 18)
#define POSITION (2 * TURN - 1)

/* From the end of the first conversion to the PWM's start, in ticks: the result passes to the FIFO,
 * the CPU sees it there and writes one register. */
#define START_TICKS 7u

__attribute__((section(".ring"), aligned(1u << RING_BITS))) static uint16_t ring[RING_SIZE];
static struct moment begin;
static uint32_t ticks_per_sample;
static uint32_t read_position;
static bool overflowed;  /* the FIFO; and it is not yet known what that has cost */
static uint32_t skipped; /* conversions whose results did not come to the ring */

void sampler_init(void)
{
    PADS_BANK0->gpio[PIN_LINE] = PAD_NO_OUTPUT;
}

uint32_t sampler_start(uint32_t ticks, struct moment *moment)
{
    const uint32_t channel = DMA_EN | DMA_HALFWORDS | DMA_INCR_WRITE | DMA_RING_WRITE(RING_BITS) |
                             DMA_TREQ(DREQ_ADC) | DMA_QUIET;

    reset_blocks(RESET_ADC);
    ADC->cs = ADC_CS_EN;
    while (!(ADC->cs & ADC_CS_READY))
        ;
    ADC->fcs = ADC_FCS_EN | ADC_FCS_THRESH_1;
    for (int n = DMA_SAMPLES_A; n <= DMA_SAMPLES_B; n++) {
        DMA_CHANNEL(n)->read_addr = (uint32_t)&ADC->fifo;
        DMA_CHANNEL(n)->write_addr = (uint32_t)ring;
        DMA_CHANNEL(n)->trans_count = TURN;
    }
    DMA_CHANNEL(DMA_SAMPLES_B)->al1_ctrl = channel | DMA_CHAIN_TO(DMA_SAMPLES_A);
    DMA_CHANNEL(DMA_SAMPLES_A)->ctrl_trig = channel | DMA_CHAIN_TO(DMA_SAMPLES_B);

    /* The PWM starts when the first result is seen, which tells when its conversion began without
     * relying on how soon the ADC does what it is told. */
    interrupts_off();
    ADC->div = (ticks - 1) << 8; /* just now: the divider starts anew with it */
    ADC->cs = ADC_CS_EN | ADC_CS_START_MANY;
    while (ADC->fcs & ADC_FCS_EMPTY)
        ;
    PWM->slice[0].csr = PWM_CSR_EN;
    ADC->fcs = ADC_FCS_EN | ADC_FCS_THRESH_1 | ADC_FCS_DREQ; /* soon: the FIFO holds 4 */
    uint32_t us = TIMER->timerawl;
    while (TIMER->timerawl == us)
        ;
    uint32_t counted = PWM->slice[0].ctr;
    moment->us = time_us();
    interrupts_on();

    /* a sample is taken in the middle of its period: the first, half a period after tick 0 */
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
    ADC->cs = ADC_CS_EN;
}

void sampler_stop(void)
{
    reset_blocks(RESET_ADC);
    DMA_CHANNEL(DMA_SAMPLES_A)->al1_ctrl = 0; /* or the end of one would start the other */
    DMA_CHANNEL(DMA_SAMPLES_B)->al1_ctrl = 0;
    DMA->chan_abort = 1u << DMA_SAMPLES_A | 1u << DMA_SAMPLES_B;
    while (DMA->chan_abort)
        ;
}

/* How many samples DMA has written. Between two turns, for some clocks, neither channel is busy. */
static uint32_t position(void)
{
    for (;;) {
        if (DMA_CHANNEL(DMA_SAMPLES_A)->ctrl_trig & DMA_BUSY)
            return TURN - DMA_CHANNEL(DMA_SAMPLES_A)->trans_count;
        if (DMA_CHANNEL(DMA_SAMPLES_B)->ctrl_trig & DMA_BUSY)
            return (2 * TURN - DMA_CHANNEL(DMA_SAMPLES_B)->trans_count) & POSITION;
    }
}

/* After the FIFO has overflowed: how many results this has cost is known from the time. Where in
 * between they are missing is not, so all since the last look are lost. Returns how many; 0 while
 * the FIFO is not empty. */
static uint32_t count_lost(void)
{
    uint32_t us, written, rest;
    uint64_t ticks;
    bool drained;

    do { /* until the time, just known, is far from a conversion's end */
        interrupts_off();
        us = TIMER->timerawl;
        while (TIMER->timerawl == us)
            ;
        drained = ADC->fcs & ADC_FCS_EMPTY; /* before the position, which else may lack the last */
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
    if (ADC->fcs & ADC_FCS_OVER) { /* looked at after the position: all before that is whole */
        ADC->fcs = ADC_FCS_EN | ADC_FCS_THRESH_1 | ADC_FCS_DREQ | ADC_FCS_OVER;
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
    *samples = ring + place;
    if (waiting > RING_SIZE - place)
        waiting = RING_SIZE - place;
    return waiting < DG_CHUNK ? waiting : DG_CHUNK;
}

void sampler_done(size_t size)
{
    read_position = (read_position + size) & POSITION;
}
