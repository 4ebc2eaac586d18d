// SPDX-License-Identifier: Apache-2.0

#include "reference.h"


static size_t packet(struct input *input, uint8_t type, const void *payload, size_t size,
                     uint8_t *wire)
{
    uint8_t body[COMMANDS_MAX];
    struct tp_header header = {type, input_u16(input)};

    memcpy(body, &header, sizeof header);
    memcpy(body + sizeof header, payload, size);
    return framing_wrap(body, sizeof header + size, wire);
}

size_t commands_plain(struct input *input, uint8_t type, uint8_t *wire)
{
    return packet(input, type, "", 0, wire);
}

size_t commands_any(struct input *input, uint8_t *wire)
{
    static const uint8_t types[] = {TP_GET_INFO, TP_START, TP_STOP, TP_PACK, TP_GROUPS, TP_NUMBER};
    uint8_t type = input_u8(input);
    const uint8_t *payload;

    if (type < 0xC0 && types[type % sizeof types] == TP_GROUPS) {
        uint8_t choice = input_u8(input), log2_groups = choice % 6;
        return packet(input, choice < 0xC0 ? TP_GROUPS : TP_ASK, &log2_groups, 1, wire);
    }
    if (type < 0xC0 && types[type % sizeof types] == TP_NUMBER) {
        struct tp_number number = {.number = input_u16(input) % 1100, .forget = input_u8(input) % 3};
        return packet(input, TP_NUMBER, &number, sizeof number, wire);
    }
    if (type < 0xC0)
        return commands_plain(input, types[type % sizeof types], wire);
    type = input_u8(input);
    size_t most = type == TP_CONFIGURE ? sizeof(struct tp_configure) : input_u8(input);
    size_t size = input_bytes(input, &payload, most);
    return packet(input, type, payload, size, wire);
}

/* Time for the chips of a frame, its guards among them, µs. */
static uint64_t frame_us(const struct tp_frame_layout *frame)
{
    uint64_t chips = (uint64_t)(frame->bits + frame->parity) * frame->order;
    uint64_t guards = frame->resync_chips ? (chips - 1) / frame->resync_chips * frame->guard_chips : 0;

    return ((chips + guards) * frame->chip_ns + 999) / 1000;
}

size_t commands_configure(struct input *input, const struct dg_board *board, uint8_t *wire)
{
    struct tp_configure asked = {0};
    struct tp_frame_layout *frame = &asked.frame;
    uint8_t flags = input_u8(input);

    frame->nodes = 1 + input_u8(input) % 20;
    frame->bits = 8 + input_u8(input) % 9;
    frame->order = 1 + input_u8(input) % 40;
    frame->samples_per_chip = 1 + input_u8(input) % 8;
    frame->chip_ns = board->min_ticks * frame->samples_per_chip * 1000u / board->ticks_per_us +
                     (uint32_t)input_u16(input);
    frame->polarity = flags & 1 ? -1 : 1;
    frame->parity = flags >> 1 & 1;
    asked.integrated = flags >> 2 & 1;
    asked.sync_mode = (flags >> 3 & 3) % 3;
    uint8_t wire_of_pulses = input_u8(input);
    asked.sync_wire = wire_of_pulses & 1;
    if (flags & 0x20) {
        frame->resync_chips = 1 + input_u8(input);
        frame->guard_chips = input_u8(input) % 8;
    }
    asked.quiet_uv = flags & 0x40 ? input_u16(input) * 8u : 0;
    frame->frame_period_us = (uint32_t)frame_us(frame) + input_u16(input);
    if (flags & 0x80) /* and anything in one place */
        ((uint8_t *)&asked)[input_u8(input) % sizeof asked] = input_u8(input);
    size_t absent = wire_of_pulses & 2 && !asked.sync_wire;
    return packet(input, TP_CONFIGURE, &asked, sizeof asked - absent, wire);
}
