// SPDX-License-Identifier: Apache-2.0

#include "reference.h"

#include <stdlib.h>
#include <string.h>

#include "setup.h"

static const struct wishes no_wishes = {.words_log2 = -1};

#define COMMANDS 0x80
#define OLD_CONFIGURE 36 /* octets of CONFIGURE and INFO without sync_wire, which is then 0 */
#define OLD_INFO 65

void host_init(struct host *host, const struct dg_board *board)
{
    memset(host, 0, sizeof *host);
    host->board = board;
    host->wishes = no_wishes;
    settings_of(&host->settings, board, &setup_default);
}

void host_free(struct host *host)
{
    free(host->answers);
}

static void keep(struct host_run *run, uint8_t byte)
{
    if (run->size < sizeof run->bytes)
        run->bytes[run->size] = byte;
    run->size++;
}

/* What it sends */

static enum tp_result configured(struct host *host, const uint8_t *payload, size_t size)
{
    struct tp_configure asked = {0};

    memcpy(&asked, payload, size);
    enum tp_result result = settings_of(&host->settings, host->board, &asked);
    if (result == TP_RESULT_OK) {
        host->restarted |= host->running;
        host->running = host->packs = false;
        host->wishes = no_wishes;
    }
    return result;
}

static enum tp_result done(struct host *host, uint8_t type, const uint8_t *payload, size_t size)
{
    if (type != TP_GET_INFO && type != TP_START && type != TP_STOP && type != TP_CONFIGURE &&
        type != TP_PACK && type != TP_GROUPS && type != TP_NUMBER && type != TP_ASK)
        return TP_RESULT_UNKNOWN_COMMAND;
    if (size != (type == TP_CONFIGURE ? sizeof(struct tp_configure) - (size == OLD_CONFIGURE)
                 : type == TP_NUMBER  ? 3
                 : type == TP_GROUPS || type == TP_ASK ? 1
                                                       : 0))
        return TP_RESULT_BAD_LENGTH;
    if (type == TP_CONFIGURE)
        return configured(host, payload, size);
    if (type == TP_GROUPS) {
        if (payload[0] > 4)
            return TP_RESULT_OUT_OF_RANGE;
        if (!host->running || !settings_has_turns(&host->settings))
            return TP_RESULT_UNSUPPORTED;
        host->wishes.log2_groups = payload[0];
    } else if (type == TP_ASK) {
        if (payload[0] > 4)
            return TP_RESULT_OUT_OF_RANGE;
        if (!host->running || !settings_can_ask(&host->settings))
            return TP_RESULT_UNSUPPORTED;
        host->wishes.words_log2 = (int8_t)payload[0];
    } else if (type == TP_NUMBER) {
        uint16_t number = (uint16_t)(payload[0] | payload[1] << 8);

        if (number > 1023 || payload[2] > 1)
            return TP_RESULT_OUT_OF_RANGE;
        if (!host->running || !settings_has_numbers(&host->settings))
            return TP_RESULT_UNSUPPORTED;
        host->wishes.number = (uint16_t)(number || payload[2] ? 1u | number << 5 | payload[2] << 15 : 0u);
    } else if (type == TP_PACK) {
        host->packs = true;
    } else if (type != TP_GET_INFO) {
        host->restarted |= type == TP_START || host->running;
        host->running = type == TP_START;
        host->wishes = no_wishes;
    }
    return TP_RESULT_OK;
}

/* Whether words are counts, so that 12 bits hold them: they are no means. */
static bool sends_counts(const struct settings *settings)
{
    return !settings->asked.integrated || settings->chip == (wide)1000 * settings->ticks_per_sample;
}

static void command(struct host *host, const uint8_t *body, size_t size)
{
    struct tp_header header;
    struct host_answer answer = {0};

    memcpy(&header, body, sizeof header);
    enum tp_result result = done(host, header.type, body + sizeof header, size - sizeof header);
    answer.ack = (struct tp_ack){header.type, header.sequence, (uint8_t)result};
    answer.settings = host->settings;
    answer.packed = host->packs && sends_counts(&host->settings);
    answer.info = header.type == TP_CONFIGURE
                      ? result == TP_RESULT_OK || result == TP_RESULT_UNSUPPORTED
                      : header.type == TP_GET_INFO && result == TP_RESULT_OK;
    host->refused += result != TP_RESULT_OK;
    host->answers = realloc(host->answers, (host->answers_size + 1) * sizeof answer);
    host->answers[host->answers_size++] = answer;
}

void host_sends(struct host *host, const uint8_t *bytes, size_t size)
{
    static uint8_t body[FRAMING_MAX_RUN];

    for (size_t i = 0; i < size; i++) {
        if (bytes[i]) {
            keep(&host->sent, bytes[i]);
            continue;
        }
        size_t body_size = framing_unwrap(host->sent.bytes, host->sent.size, body);
        if (body_size && body[0] >= COMMANDS)
            command(host, body, body_size);
        else
            host->errors += host->sent.size > 0;
        host->sent.size = 0;
    }
}

/* What it hears */

static bool says(const struct tp_info *info, const struct tp_configure *asked)
{
    return !memcmp(&info->frame, &asked->frame, sizeof info->frame) &&
           info->sync_mode == asked->sync_mode && info->integrated == asked->integrated &&
           info->quiet_uv == asked->quiet_uv && info->sync_wire == asked->sync_wire;
}

static void check_info(const struct host *host, const struct tp_info *info)
{
    const struct dg_board *board = host->board;
    const struct host_answer *answer = &host->answers[host->answered - 1];
    int scale = info->integrated ? 8 : 1;

    /* Commands whose ACK was dropped have been obeyed all the same. */
    uint32_t dropped = host->missing - host->unanswered;
    while (!says(info, &answer->settings.asked) && dropped-- > 0 &&
           answer + 1 < host->answers + host->answers_size)
        answer++;
    MUST(says(info, &answer->settings.asked), WRONG_VALUE);
    MUST(info->volts_per_count * (float)scale == board->volts_per_count, WRONG_VALUE);
    MUST(info->zero_count == board->zero_count * scale, WRONG_VALUE);
    MUST(info->min_count == board->min_count * scale, WRONG_VALUE);
    MUST(info->max_count == board->max_count * scale, WRONG_VALUE);
}

/* The answer that this is; those before it were dropped. */
static void check_ack(struct host *host, const struct tp_ack *ack)
{
    while (host->answered < host->answers_size &&
           memcmp(&host->answers[host->answered].ack, ack, sizeof *ack)) {
        host->answered++;
        host->unanswered++;
    }
    MUST(host->answered < host->answers_size, WRONG_VALUE);
    MUST(host->unanswered <= host->missing, UNCOUNTED_LOSS);
    host->info_due = host->answers[host->answered++].info;
}

/* Whether the samples heard now may be packed, or not: as the last answer says, or one whose ACK was
 * dropped. */
static void check_kind(const struct host *host, bool packed)
{
    size_t next = host->answered, dropped = host->missing - host->unanswered;
    bool may_be = next ? host->answers[next - 1].packed == packed : !packed;

    for (; !may_be && dropped > 0 && next < host->answers_size; next++, dropped--)
        may_be = host->answers[next].packed == packed;
    MUST(may_be, WRONG_VALUE);
}

static void check_samples(const struct host *host, const uint8_t *payload, size_t size)
{
    struct tp_samples head;

    check_kind(host, false);
    MUST(size > sizeof head && (size - sizeof head) % 2 == 0, WRONG_VALUE);
    memcpy(&head, payload, sizeof head);
    struct line_packet packet = {
        .device_time_us = head.device_time_us,
        .first = head.first_index,
        .flags = head.flags,
        .count = (uint32_t)(size - sizeof head) / 2,
        .words = payload + sizeof head,
    };
    host->samples(host->context, &packet, host->packet_begin);
}

static void check_packed(const struct host *host, const uint8_t *payload, size_t size)
{
    static uint8_t words[2 * TP_MAX_SAMPLES];
    struct tp_packed head;

    check_kind(host, true);
    MUST(size > sizeof head && (size - sizeof head) % 3 != 1, WRONG_VALUE);
    memcpy(&head, payload, sizeof head);
    struct line_packet packet = {
        .device_time_us = head.device_time_us,
        .first = head.first_index,
        .flags = head.flags,
        .count = (uint32_t)((size - sizeof head) * 2 / 3),
        .words = words,
    };
    MUST(packet.count <= TP_MAX_SAMPLES, WRONG_VALUE);
    for (uint32_t i = 0; i < packet.count; i++) { /* 12 bits from half byte 3·i on */
        const uint8_t *at = payload + sizeof head + 3 * i / 2;
        unsigned value = i % 2 ? at[0] >> 4 | (unsigned)at[1] << 4 : at[0] | (at[1] & 15u) << 8;
        uint16_t word = (uint16_t)(head.base + (int)((value ^ 0x555u) * head.step)) ^ TP_SAMPLE_XOR;
        memcpy(words + 2 * i, &word, sizeof word);
    }
    host->samples(host->context, &packet, host->packet_begin);
}

static void check_quiet(const struct host *host, const uint8_t *payload, size_t size)
{
    struct tp_quiet quiet;

    MUST(size == sizeof quiet, WRONG_VALUE);
    memcpy(&quiet, payload, sizeof quiet);
    struct line_packet packet = {
        .device_time_us = quiet.device_time_us,
        .first = quiet.first_index,
        .flags = quiet.flags,
        .count = quiet.count,
        .sum = quiet.sum,
        .sum_of_squares = quiet.sum_of_squares,
    };
    host->samples(host->context, &packet, host->packet_begin);
}

static void packet(struct host *host, const uint8_t *body, size_t size)
{
    struct tp_header header;
    struct tp_info info = {0};
    struct tp_ack ack;
    const uint8_t *payload = body + sizeof header;

    memcpy(&header, body, sizeof header);
    size -= sizeof header;
    uint16_t missing = (uint16_t)(header.sequence - host->sequence);
    bool info_due = host->info_due && !missing;
    host->missing += missing;
    host->sequence = (uint16_t)(header.sequence + 1);
    host->info_due = false;
    MUST(!info_due || header.type == TP_INFO, WRONG_VALUE);
    switch (header.type) {
    case TP_INFO:
        MUST(size == OLD_INFO || size == sizeof info, WRONG_VALUE);
        memcpy(&info, payload, size);
        MUST((size == OLD_INFO) == (info.sync_wire == 0), WRONG_VALUE);
        if (info_due)
            check_info(host, &info);
        break;
    case TP_ACK:
        MUST(size == sizeof ack, WRONG_VALUE);
        memcpy(&ack, payload, sizeof ack);
        check_ack(host, &ack);
        break;
    case TP_STATUS:
        MUST(size == sizeof host->status, WRONG_VALUE);
        memcpy(&host->status, payload, sizeof host->status);
        break;
    case TP_SAMPLES:
        check_samples(host, payload, size);
        break;
    case TP_PACKED:
        check_packed(host, payload, size);
        break;
    default:
        MUST(header.type == TP_QUIET, WRONG_VALUE);
        check_quiet(host, payload, size);
    }
}

void host_hears(struct host *host, const uint8_t *bytes, size_t size)
{
    static uint8_t body[FRAMING_MAX_RUN];

    for (size_t i = 0; i < size; i++) {
        host->heard_size++;
        if (bytes[i]) {
            keep(&host->heard, bytes[i]);
            continue;
        }
        if (host->heard.size) {
            size_t body_size = framing_unwrap(host->heard.bytes, host->heard.size, body);
            MUST(body_size > 0, WRONG_VALUE);
            packet(host, body, body_size);
        }
        host->heard.size = 0;
        host->packet_begin = host->heard_size;
    }
}

void host_check_end(const struct host *host)
{
    MUST(host->heard.size == 0, WRONG_VALUE);
    size_t unanswered = host->unanswered + host->answers_size - host->answered;
    MUST(unanswered <= host->missing, UNCOUNTED_LOSS);
    MUST(host->status.packets_dropped == host->missing, UNCOUNTED_LOSS);
    MUST(host->status.commands_refused == host->refused, UNCOUNTED_LOSS);
    MUST(host->status.command_errors == host->errors, UNCOUNTED_LOSS);
    MUST(host->status.streaming == host->running, WRONG_VALUE);
}
