// SPDX-License-Identifier: Apache-2.0

#include "pins.h"

#include <string.h>

#include "demonstrator.h"
#include "registers.h"
#include "rp2040.h"

#define PIO_PER_US 96u /* the state machine's cycles: those of clk_sys */
/* Cycles from a pulse's edge to the first chip beside those that are counted: 2 for the input's
 * synchroniser, 4 for instructions, 1 for the output. */
#define LEAD_OTHERWISE 7u
#define CHIP_OTHERWISE 5u /* cycles of a chip beside those that are counted, by the program below */
#define ALL_PINS ((1u << DEMO_NODES) - 1)

/* Instructions as in the data sheet, 3.4. */
#define WAIT_LOW(pin) (0x2000u | (pin))
#define WAIT_HIGH(pin) (0x2080u | (pin))
#define OUT(destination, bits) (0x6000u | (destination) << 5 | ((bits) & 31u))
#define JMP_X_DEC(address) (0x0040u | (address))
#define JMP_Y_DEC(address) (0x0080u | (address))
#define MOV_X_ISR 0xa026u
enum { PINS = 0, X = 1, Y = 2, PINDIRS = 4, ISR = 6 };

static const uint16_t program[] = {
    WAIT_LOW(PIN_SYNC),
    WAIT_HIGH(PIN_SYNC),
    OUT(X, 32),         /* the lead */
    JMP_X_DEC(3),
    OUT(ISR, 32),       /* duration of a chip */
    OUT(Y, 32),         /* chips, less one */
    OUT(PINS, 16),
    OUT(PINDIRS, 16),
    MOV_X_ISR,
    JMP_X_DEC(9),
    JMP_Y_DEC(6),
};
#define PROGRAM_SIZE (sizeof program / sizeof *program)

static struct {
    uint32_t lead, chip_cycles, chips_less_one, chips[DEMO_CHIPS + 1];
} frame;

static void release(void)
{
    SIO->gpio_oe_clr = ALL_PINS;
    for (uint32_t pin = 0; pin < DEMO_NODES; pin++)
        IO_BANK0->io[pin].ctrl = GPIO_FUNC_SIO;
}

void pins_init(void)
{
    release();
    for (uint32_t pin = 0; pin < DEMO_NODES; pin++)
        PADS_BANK0->io[pin] = PAD_DRIVE_4MA; /* without the pull-down of a reset */
}

static int32_t converted(void)
{
    ADC->cs = ADC_CS_EN_BITS | ADC_CS_START_ONCE_BITS;
    while (!(ADC->cs & ADC_CS_READY_BITS))
        ;
    return (int32_t)ADC->result;
}

/* All pins go up and down together. By one resistor of 100 kΩ the line would go up and down by 40 counts;
 * without any it rests, held by the pull-down, whatever it might pick up otherwise. */
bool pins_are_wired(void)
{
    const int32_t rounds = 64, least = 20; /* counts. Chosen: half of one resistor's */
    int32_t sum = 0;

    reset_blocks(RESETS_RESET_ADC_BITS);
    PADS_BANK0->io[PIN_LINE] = PADS_BANK0_GPIO0_OD_BITS | PADS_BANK0_GPIO0_PDE_BITS;
    ADC->cs = ADC_CS_EN_BITS;
    while (!(ADC->cs & ADC_CS_READY_BITS))
        ;
    SIO->gpio_oe_set = ALL_PINS;
    for (int32_t i = 0; i < rounds; i++) {
        SIO->gpio_set = ALL_PINS;
        for (int n = 0; n < 8; n++) /* 16 µs, in which the line settles */
            converted();
        sum += converted();
        SIO->gpio_clr = ALL_PINS;
        for (int n = 0; n < 8; n++)
            converted();
        sum -= converted();
    }
    SIO->gpio_oe_clr = ALL_PINS;
    PADS_BANK0->io[PIN_LINE] = PADS_BANK0_GPIO0_OD_BITS;
    return sum > rounds * least;
}

void pins_start(uint32_t chip_us)
{
    pins_stop();
    frame.lead = TP_SYNC_LEAD * TP_SYNC_UNIT_US * PIO_PER_US - LEAD_OTHERWISE - 1;
    frame.chip_cycles = chip_us * PIO_PER_US - CHIP_OTHERWISE;
    for (uint32_t i = 0; i < PROGRAM_SIZE; i++)
        PIO0->instr_mem[i] = program[i];
    PIO0->sm[0].execctrl = PIO_EXECCTRL_WRAP(0, PROGRAM_SIZE - 1);
    PIO0->sm[0].shiftctrl = PIO_SM0_SHIFTCTRL_OUT_SHIFTDIR_BITS | PIO_SM0_SHIFTCTRL_AUTOPULL_BITS;
    PIO0->sm[0].pinctrl = PIO_PINCTRL_OUT(0, DEMO_NODES);
    for (uint32_t pin = 0; pin < DEMO_NODES; pin++)
        IO_BANK0->io[pin].ctrl = GPIO_FUNC_PIO0;
    PIO0->ctrl = PIO_CTRL_SM0_ENABLE;
}

void pins_stop(void)
{
    release();
    DMA_CHANNEL(DMA_PINS)->al1_ctrl = 0;
    DMA->abort = 1u << DMA_PINS;
    while (DMA->abort)
        ;
    reset_blocks(RESETS_RESET_PIO0_BITS);
}

bool pins_want_frame(void)
{
    return !(DMA_CHANNEL(DMA_PINS)->ctrl_trig & DMA_CH0_CTRL_TRIG_BUSY_BITS);
}

void pins_play(const uint32_t *chips, uint32_t count)
{
    frame.chips_less_one = count - 1;
    memcpy(frame.chips, chips, count * sizeof *chips);
    DMA_CHANNEL(DMA_PINS)->read_addr = (uint32_t)&frame;
    DMA_CHANNEL(DMA_PINS)->write_addr = (uint32_t)&PIO0->txf[0];
    DMA_CHANNEL(DMA_PINS)->transfer_count = 3 + count;
    DMA_CHANNEL(DMA_PINS)->ctrl_trig = DMA_CH0_CTRL_TRIG_EN_BITS | DMA_WORDS |
                                       DMA_CH0_CTRL_TRIG_INCR_READ_BITS | DMA_CH0_CTRL_TRIG_IRQ_QUIET_BITS |
                                       DMA_TREQ(DREQ_PIO0_TX0) | DMA_CHAIN_TO(DMA_PINS);
}

/* The state machine lacks data only then: it waits for a pulse before it takes any of the next frame. */
bool pins_failed(void)
{
    return PIO0->fdebug & PIO_FDEBUG_TXSTALL_SM0;
}
