// SPDX-License-Identifier: Apache-2.0

/* Any CONFIGURE for any board: its acceptance and the derived settings match exact arithmetic. */
#include "setup.h"

#include "reference.h"

/* A board for which setup_default is possible, as board.h requires. */
static struct dg_board board_of(struct input *input)
{
    static const uint16_t ticks_per_us[] = {8, 48, 64, 125, 133, 1000};
    struct dg_board board = {
        .ticks_per_us = ticks_per_us[input_u8(input) % 6],
        .min_ticks = 1 + input_u8(input) % 96,
        .volts_per_count = 0x1p-10f,
        .max_count = 4095,
    };

    board.max_ticks = 12500 + input_u32(input) % (4194303 - 12500);
    return board;
}

static wide length(const struct stride *stride)
{
    return (wide)stride->samples * stride->sample + stride->rest;
}

static void check(const struct setup *setup, const struct settings *wanted)
{
    const struct tp_frame_layout *frame = &wanted->asked.frame;
    wide sample = (wide)1000 * wanted->ticks_per_sample;
    wide rate = wanted->asked.integrated ? (wide)1000000000000000
                                         : (wide)1000000000000 * wanted->ticks_per_us;
    wide per = wanted->asked.integrated ? frame->chip_ns : wanted->ticks_per_sample;
    wide span = settings_chip(wanted, wanted->chips - 1) + (1 + TP_TAIL_CHIPS) * wanted->chip;

    MUST(!memcmp(&setup->asked, &wanted->asked, sizeof wanted->asked), WRONG_VALUE);
    MUST(setup->marked == wanted->marked && setup->chips == wanted->chips, WRONG_VALUE);
    MUST(setup->ticks_per_sample == wanted->ticks_per_sample, WRONG_VALUE);
    MUST(setup->sample_rate_uhz == (rate + per / 2) / per, WRONG_VALUE);
    MUST(setup->quiet_counts == wanted->quiet_counts, WRONG_VALUE);
    MUST((wide)1000 * setup->first_mark == wanted->first_mark, WRONG_VALUE);
    MUST((wide)1000 * setup->period_ticks == wanted->period, WRONG_VALUE);
    MUST(setup->frame_samples == (span + sample - 1) / sample, WRONG_VALUE);
    MUST(setup->period.sample == sample && length(&setup->period) == wanted->period, WRONG_VALUE);
    MUST(setup->chip.sample == sample && length(&setup->chip) == wanted->chip, WRONG_VALUE);
    MUST(length(&setup->guard) == wanted->chip * frame->guard_chips, WRONG_VALUE);
    MUST(setup->gap_samples > 0, WRONG_VALUE);
    for (uint32_t chip = 0; chip < wanted->chips; chip += 1 + wanted->chips / 7)
        MUST(setup_chip_place(setup, chip) == settings_chip(wanted, chip), WRONG_VALUE);
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    struct input input = {bytes, size};
    struct dg_board board = board_of(&input);
    struct tp_configure asked = setup_default;
    struct settings wanted;
    struct setup setup;

    MUST(setup_make(&setup, &board, &asked), WRONG_VALUE);
    while (input.left > 1) { /* fields become others, anywhere between nearly and not at all right */
        uint8_t place = input_u8(&input), with = input_u8(&input);
        ((uint8_t *)&asked)[place % sizeof asked] ^= with;
    }
    enum tp_result result = settings_of(&wanted, &board, &asked);
    MUST(tp_configure_in_range(&asked) == (result != TP_RESULT_OUT_OF_RANGE), WRONG_VALUE);
    if (result == TP_RESULT_OUT_OF_RANGE)
        return 0;
    MUST(setup_make(&setup, &board, &asked) == (result == TP_RESULT_OK), WRONG_VALUE);
    if (result == TP_RESULT_OK)
        check(&setup, &wanted);
    return 0;
}
