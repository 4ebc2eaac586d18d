// SPDX-License-Identifier: Apache-2.0

#include "digitizer.h"

#include <string.h>

#define COMMANDS 0x80 /* packet types from here on are commands of the host */
/* Bytes of STREAM_RESERVE that reports leave to answers. Chosen: five ACKs with INFO, 87 bytes each. */
#define ANSWERS 512

_Static_assert(ANSWERS < STREAM_RESERVE, "reports have room when samples have none");

static void report(struct dg *dg, uint8_t type, const void *payload, size_t size, size_t reserve)
{
    if (packet_open(&dg->writer, type, size, reserve)) {
        packet_put(&dg->writer, payload, size);
        packet_close(&dg->writer);
    }
}

static void report_info(struct dg *dg, size_t reserve)
{
    const struct dg_board *board = dg->board;
    const struct setup *setup = &dg->setup;
    int16_t scale = setup->asked.integrated ? SETUP_MEAN_SCALE : 1;
    struct tp_info info = {
        .version = TP_VERSION,
        .firmware_major = DG_FIRMWARE_MAJOR,
        .firmware_minor = DG_FIRMWARE_MINOR,
        .sample_rate_uhz = setup->sample_rate_uhz,
        .volts_per_count = board->volts_per_count / scale,
        .zero_count = (int16_t)(board->zero_count * scale),
        .min_count = (int16_t)(board->min_count * scale),
        .max_count = (int16_t)(board->max_count * scale),
        .sync_mode = setup->asked.sync_mode,
        .integrated = setup->asked.integrated,
        .frame = setup->asked.frame,
        .quiet_uv = setup->asked.quiet_uv,
        .sync_wire = setup->asked.sync_wire,
    };
    size_t absent = info.sync_wire == TP_SYNC_WIRE_OWN ? sizeof info.sync_wire : 0;

    memcpy(info.digitizer_id, board->id, sizeof info.digitizer_id);
    report(dg, TP_INFO, &info, sizeof info - absent, reserve);
}

static void report_status(struct dg *dg, uint64_t now_us)
{
    struct tp_status status = {
        .uptime_us = now_us,
        .samples_lost = dg->stream.samples_lost,
        .packets_dropped = dg->writer.dropped,
        .commands_refused = dg->commands_refused,
        .command_errors = dg->reader.errors,
        .sync_faults = dg->sync_faults + dg->pull.unseen + dg->pulses.unheard,
        .streaming = dg->running,
    };

    report(dg, TP_STATUS, &status, sizeof status, ANSWERS);
}

void dg_stop(struct dg *dg)
{
    pulses_end(&dg->pulses);
    dg->restarted |= dg->running;
    dg->running = dg->begun = false;
}

static bool nodes_know(const struct dg_board *board, const struct tp_frame_layout *asked)
{
    struct tp_frame_layout theirs;

    if (!board->layout)
        return true;
    theirs = *board->layout;
    theirs.samples_per_chip = asked->samples_per_chip;
    return memcmp(&theirs, asked, sizeof theirs) == 0;
}

static enum tp_result set_up(struct dg *dg, const struct tp_configure *asked)
{
    struct setup setup;

    if (!tp_configure_in_range(asked))
        return TP_RESULT_OUT_OF_RANGE;
    if ((dg->board->wireless && asked->sync_wire == TP_SYNC_WIRE_DATA) ||
        !nodes_know(dg->board, &asked->frame) || !setup_make(&setup, dg->board, asked))
        return TP_RESULT_UNSUPPORTED;
    dg_stop(dg);
    dg->setup = setup;
    dg->stream.packs = false;
    dg->ticks_per_sample = setup.ticks_per_sample;
    return TP_RESULT_OK;
}

/* Commands. payload: as large as the table below says. */

static enum tp_result get_info(struct dg *dg, const uint8_t *payload)
{
    (void)dg, (void)payload; /* the answer is followed by INFO */
    return TP_RESULT_OK;
}

static enum tp_result start(struct dg *dg, const uint8_t *payload)
{
    (void)payload;
    dg_stop(dg);
    dg->running = dg->restarted = true;
    return TP_RESULT_OK;
}

static enum tp_result stop(struct dg *dg, const uint8_t *payload)
{
    (void)payload;
    dg_stop(dg);
    return TP_RESULT_OK;
}

static enum tp_result pack(struct dg *dg, const uint8_t *payload)
{
    (void)payload;
    dg->stream.packs = true;
    return TP_RESULT_OK;
}

static enum tp_result configure(struct dg *dg, const uint8_t *payload)
{
    struct tp_configure asked = {0};

    memcpy(&asked, payload, dg->reader.payload_size); /* without sync_wire it is 0: own */
    return set_up(dg, &asked);
}

static enum tp_result divide(struct dg *dg, const uint8_t *payload)
{
    struct tp_groups asked;

    memcpy(&asked, payload, sizeof asked);
    if (!tp_groups_in_range(&asked))
        return TP_RESULT_OUT_OF_RANGE;
    if (!dg->running || dg->board->layout || !setup_has_turns(&dg->setup))
        return TP_RESULT_UNSUPPORTED;
    pulses_divide(&dg->pulses, asked.log2_groups);
    return TP_RESULT_OK;
}

static enum tp_result ask(struct dg *dg, const uint8_t *payload)
{
    struct tp_ask asked;

    memcpy(&asked, payload, sizeof asked);
    if (!tp_ask_in_range(&asked))
        return TP_RESULT_OUT_OF_RANGE;
    if (!dg->running || !setup_can_ask(&dg->setup))
        return TP_RESULT_UNSUPPORTED;
    pulses_ask(&dg->pulses, dg->board->layout ? 0 : asked.log2_groups); /* nodes here know no turns */
    return TP_RESULT_OK;
}

static enum tp_result number(struct dg *dg, const uint8_t *payload)
{
    struct tp_number asked;

    memcpy(&asked, payload, sizeof asked);
    if (!tp_number_in_range(&asked))
        return TP_RESULT_OUT_OF_RANGE;
    if (!dg->running || dg->board->layout || !setup_has_numbers(&dg->setup))
        return TP_RESULT_UNSUPPORTED;
    pulses_number(&dg->pulses, asked.number, asked.forget);
    return TP_RESULT_OK;
}

static const struct {
    uint8_t type;
    size_t least_size, payload_size;
    enum tp_result (*obey)(struct dg *dg, const uint8_t *payload);
} commands[] = {
    {TP_GET_INFO, 0, 0, get_info},
    {TP_START, 0, 0, start},
    {TP_STOP, 0, 0, stop},
    {TP_PACK, 0, 0, pack},
    {TP_CONFIGURE, offsetof(struct tp_configure, sync_wire), sizeof(struct tp_configure), configure},
    {TP_GROUPS, sizeof(struct tp_groups), sizeof(struct tp_groups), divide},
    {TP_ASK, sizeof(struct tp_ask), sizeof(struct tp_ask), ask},
    {TP_NUMBER, sizeof(struct tp_number), sizeof(struct tp_number), number},
};

/* Executes the command just read; those that are none of the table's are the board's. */
static enum tp_result obey(struct dg *dg)
{
    const struct packet_reader *reader = &dg->reader;

    for (size_t i = 0; i < sizeof commands / sizeof *commands; i++) {
        if (commands[i].type != reader->header.type)
            continue;
        if (reader->payload_size < commands[i].least_size || reader->payload_size > commands[i].payload_size)
            return TP_RESULT_BAD_LENGTH;
        return commands[i].obey(dg, reader->payload);
    }
    return dg->board->command
               ? dg->board->command(reader->header.type, reader->payload, reader->payload_size)
               : TP_RESULT_UNKNOWN_COMMAND;
}

static void answer(struct dg *dg)
{
    enum tp_result result = obey(dg);
    struct tp_ack ack = {
        .command = dg->reader.header.type,
        .command_sequence = dg->reader.header.sequence,
        .result = (uint8_t)result,
    };
    bool done = result == TP_RESULT_OK;

    dg->commands_refused += !done;
    report(dg, TP_ACK, &ack, sizeof ack, 0);
    if (ack.command == TP_CONFIGURE ? done || result == TP_RESULT_UNSUPPORTED
                                    : ack.command == TP_GET_INFO && done)
        report_info(dg, 0);
}

void dg_init(struct dg *dg, const struct dg_board *board, uint8_t *output, size_t output_size,
             int16_t *samples, size_t sample_capacity, uint64_t now_us)
{
    memset(dg, 0, sizeof *dg);
    dg->board = board;
    dg->report_us = now_us;
    packet_writer_init(&dg->writer, output, output_size);
    stream_init(&dg->stream, &dg->pulses, &dg->writer, (uint16_t *)samples, sample_capacity);
    set_up(dg, &setup_default);
}

void dg_receive(struct dg *dg, const uint8_t *bytes, size_t size, uint64_t now_us)
{
    dg_time(dg, now_us); /* reports that were due come first */
    for (size_t i = 0; i < size; i++) {
        if (!packet_read(&dg->reader, bytes[i]))
            continue;
        if (dg->reader.header.type >= COMMANDS)
            answer(dg);
        else
            dg->reader.errors++; /* a packet of a digitizer, as an echoing line returns */
    }
}

bool dg_restarted(struct dg *dg)
{
    bool restarted = dg->restarted;

    dg->restarted = false;
    return restarted;
}

void dg_begin(struct dg *dg, uint64_t start_us)
{
    dg->setup.first_mark = pulses_first_mark(&dg->pulses, &dg->setup, start_us);
    stream_begin(&dg->stream, &dg->setup, start_us);
    pulses_begin(&dg->pulses, &dg->setup, start_us);
    pull_begin(&dg->pull, &dg->pulses, dg->board);
    dg->begun = true;
}

void dg_end(struct dg *dg)
{
    if (dg->begun)
        stream_end(&dg->stream);
    dg->begun = false;
}

void dg_samples(struct dg *dg, const uint16_t *counts, size_t size)
{
    if (dg->begun)
        pull_samples(&dg->pull, &dg->stream, counts, size);
}

void dg_lost(struct dg *dg, uint32_t size)
{
    if (dg->begun && size)
        pull_lost(&dg->pull, &dg->stream, size);
}

bool dg_pulse(struct dg *dg, struct dg_pulse *pulse)
{
    return pulses_next(&dg->pulses, pulse);
}

void dg_heard(struct dg *dg, uint32_t us)
{
    pulses_heard(&dg->pulses, us);
}

bool dg_strayed(const struct dg *dg)
{
    return dg->begun && pulses_strayed(&dg->pulses);
}

void dg_sync_fault(struct dg *dg)
{
    dg->sync_faults++;
}

void dg_time(struct dg *dg, uint64_t now_us)
{
    if (now_us < dg->report_us)
        return;
    report_info(dg, ANSWERS);
    report_status(dg, now_us);
    while (dg->report_us <= now_us)
        dg->report_us += DG_REPORT_US;
}

size_t dg_output(const struct dg *dg, const uint8_t **bytes)
{
    return packet_output(&dg->writer, bytes);
}

void dg_sent(struct dg *dg, size_t size)
{
    packet_sent(&dg->writer, size);
}

void dg_drop(struct dg *dg, size_t begun)
{
    packet_drop(&dg->writer, begun);
}
