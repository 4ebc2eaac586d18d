// SPDX-License-Identifier: Apache-2.0

#include "scanner.h"

#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#define SEQUENCES 65536
#define COMMAND_BIT 0x80
#define RESIDUE 0x2144DF1Cu /* the CRC-32 of any bytes that are followed by their own CRC-32 */
#define FULL 255            /* COBS: length of a block that no zero follows */
#define MOST_PACKED ((1 << TP_PACKED_BITS) - 1)
#define PACKED_XOR (TP_SAMPLE_XOR & MOST_PACKED)
#define HEADER_SIZE sizeof(struct tp_header)
#define CRC_SIZE sizeof(uint32_t)
#define MAX_RUN (TP_MAX_PACKET - 1)
#define LARGEST_EXACT ((uint64_t)1 << 53) /* up to which a double holds every integer */

enum past { NEVER, RECEIVED, MISSING };

/* ---- CRC-32 ------------------------------------------------------------------------------------ */

/* CRC-32 of IEEE 802.3, as zlib's, of 16 bytes at a time (Kounavis and Berry 2005, "slicing by 8"): table[r] has what a
 * byte gives that r others follow. Every byte of the stream passes here: 4 MB/s take 0.13 % of a core of 2026; by eight
 * bytes 0.2 %, by one 0.9 %, with zlib 0.1 %, and by carry-less multiplication, 60 lines for x86 only, 0.03 %. Each
 * scanner has its own, which no other thread reads while it is made. */
#define CRC_STEP 16
typedef uint32_t crc_table[CRC_STEP][256];

static void prepare_crc(crc_table table)
{
    for (uint32_t byte = 0; byte < 256; byte++) {
        uint32_t crc = byte;
        for (int bit = 0; bit < 8; bit++)
            crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320u : 0);
        table[0][byte] = crc;
    }
    for (int row = 1; row < CRC_STEP; row++)
        for (int byte = 0; byte < 256; byte++) {
            uint32_t before = table[row - 1][byte];
            table[row][byte] = before >> 8 ^ table[0][before & 255];
        }
}

static uint32_t crc_of(crc_table table, const uint8_t *bytes, size_t size)
{
    uint32_t crc = UINT32_MAX, fours[CRC_STEP / 4];

    for (; size >= CRC_STEP; size -= CRC_STEP, bytes += CRC_STEP) {
        memcpy(fours, bytes, CRC_STEP);
        fours[0] ^= crc;
        crc = 0;
        for (size_t i = 0; i < CRC_STEP / 4; i++) {
            uint32_t four = fours[i], (*row)[256] = &table[CRC_STEP - 4 - 4 * i];
            crc ^= row[3][four & 255] ^ row[2][four >> 8 & 255] ^ row[1][four >> 16 & 255] ^ row[0][four >> 24];
        }
    }
    while (size--)
        crc = crc >> 8 ^ table[0][(crc ^ *bytes++) & 255];
    return ~crc;
}

/* ---- packets ----------------------------------------------------------------------------------- */

struct scanner {
    unsigned long most_repeated, repeated; /* in a row */
    bool skipping; /* until the next delimiter: the run is too long for a packet, or cut */
    bool started;
    uint16_t expected;
    size_t partial; /* bytes after the last delimiter */
    struct scanner_counts seen, told;
    uint8_t run[MAX_RUN], raw[MAX_RUN];
    uint8_t past[SEQUENCES]; /* of the last packet of each sequence number; */
    uint32_t crc[SEQUENCES]; /* its CRC */
    crc_table table;
};

struct scanner *scanner_new(unsigned long most_repeated)
{
    struct scanner *scanner = calloc(1, sizeof *scanner);

    if (scanner) {
        prepare_crc(scanner->table);
        scanner->most_repeated = most_repeated;
    }
    return scanner;
}

void scanner_free(struct scanner *scanner)
{
    free(scanner);
}

static uint64_t text_bytes(const uint8_t *bytes, size_t size)
{
    uint64_t count = 0;

    for (size_t i = 0; i < size; i++) {
        uint8_t byte = bytes[i];
        count += (byte >= 0x20 && byte < 0x7F) || byte == '\t' || byte == '\r' || byte == '\n';
    }
    return count;
}

static void no_packet(struct scanner *scanner, const uint8_t *bytes, size_t size)
{
    if (!scanner->seen.packets)
        scanner->seen.text_bytes += text_bytes(bytes, size);
}

/* Decodes into scanner->raw. Returns the size, or SIZE_MAX if the run is not COBS. */
static size_t decode(struct scanner *scanner, const uint8_t *run, size_t size)
{
    uint8_t *out = scanner->raw;

    for (size_t in = 0; in < size;) {
        size_t length = run[in];
        if (length > size - in)
            return SIZE_MAX;
        memcpy(out, run + in + 1, length - 1);
        out += length - 1;
        in += length;
        if (length != FULL && in < size)
            *out++ = 0;
    }
    return (size_t)(out - scanner->raw);
}

/* Counts a packet out of sequence; false for a repetition. */
static bool count_step(struct scanner *scanner, uint8_t type, uint16_t sequence, uint32_t crc)
{
    if (!scanner->started)
        return true;
    uint16_t gap = (uint16_t)(sequence - scanner->expected);
    if (gap <= TP_MAX_GAP) {
        scanner->seen.lost_packets += gap;
        for (uint16_t lost = scanner->expected; lost != sequence; lost++)
            scanner->past[lost] = MISSING;
        return true;
    }
    uint8_t past = scanner->past[sequence];
    bool known = past == MISSING || (past == RECEIVED && scanner->crc[sequence] == crc);
    if (known && !(type & COMMAND_BIT) && scanner->repeated < scanner->most_repeated) {
        scanner->repeated++;
        scanner->seen.repeated_packets++;
        return false;
    }
    scanner->seen.jumps++;
    return true;
}

/* The packet between two delimiters, if there is one to pass on. */
static bool parse(struct scanner *scanner, const uint8_t *run, size_t size, struct scanner_packet *packet)
{
    struct tp_header header;
    uint32_t crc;
    size_t raw_size = decode(scanner, run, size);
    bool is_framed = raw_size != SIZE_MAX;

    if (!is_framed || raw_size < CRC_SIZE || crc_of(scanner->table, scanner->raw, raw_size) != RESIDUE) {
        *(is_framed ? &scanner->seen.crc_errors : &scanner->seen.framing_errors) += 1;
        no_packet(scanner, run, size);
        return false;
    }
    scanner->seen.packets++;
    if (raw_size < HEADER_SIZE + CRC_SIZE) {
        scanner->seen.malformed++;
        return false;
    }
    memcpy(&header, scanner->raw, HEADER_SIZE);
    memcpy(&crc, scanner->raw + raw_size - CRC_SIZE, CRC_SIZE);
    uint16_t sequence = header.sequence;
    uint64_t jumps = scanner->seen.jumps;
    bool follows = (scanner->started && sequence == scanner->expected) ||
                   count_step(scanner, header.type, sequence, crc);
    if (follows) {
        scanner->past[sequence] = RECEIVED;
        scanner->crc[sequence] = crc;
        scanner->repeated = 0;
        scanner->expected = (uint16_t)(sequence + 1);
        scanner->started = true;
    } else if (header.type == TP_SAMPLES || header.type == TP_PACKED || header.type == TP_QUIET) {
        return false;
    }
    *packet = (struct scanner_packet){header.type, sequence, scanner->raw + HEADER_SIZE,
                                      raw_size - HEADER_SIZE - CRC_SIZE, !follows,
                                      scanner->seen.jumps > jumps};
    return true;
}

/* Adds bytes to the run; false if that is too long for a packet, or cut. */
static bool extend(struct scanner *scanner, const uint8_t *bytes, size_t size)
{
    if (!scanner->skipping && size <= MAX_RUN - scanner->partial) {
        memcpy(scanner->run + scanner->partial, bytes, size);
        scanner->partial += size;
        return true;
    }
    if (!scanner->skipping) {
        scanner->seen.resyncs++;
        no_packet(scanner, scanner->run, scanner->partial);
    }
    no_packet(scanner, bytes, size);
    scanner_skip(scanner);
    return false;
}

/* Bytes up to a delimiter, which is not among them. */
static bool end_run(struct scanner *scanner, const uint8_t *bytes, size_t size, struct scanner_packet *packet)
{
    if (scanner->skipping || scanner->partial || size > MAX_RUN) { /* else it needs no copy */
        size = extend(scanner, bytes, size) ? scanner->partial : 0;
        bytes = scanner->run;
        scanner->skipping = false;
        scanner->partial = 0;
    }
    return size && parse(scanner, bytes, size, packet);
}

size_t scanner_take(struct scanner *scanner, const uint8_t *bytes, size_t size, struct scanner_packet *packet)
{
    const uint8_t *next = bytes, *end = bytes + size;
    bool found = false;

    packet->payload = NULL;
    while (next != end && !found) {
        const uint8_t *zero = memchr(next, 0, (size_t)(end - next));
        if (zero) {
            found = end_run(scanner, next, (size_t)(zero - next), packet);
            next = zero + 1;
        } else {
            extend(scanner, next, (size_t)(end - next));
            next = end;
        }
    }
    scanner->seen.bytes += (uint64_t)(next - bytes);
    return (size_t)(next - bytes);
}

void scanner_skip(struct scanner *scanner)
{
    scanner->partial = 0;
    scanner->skipping = true;
}

size_t scanner_held(const struct scanner *scanner)
{
    return scanner->partial;
}

const struct scanner_counts *scanner_tell(struct scanner *scanner)
{
    struct scanner_counts counts = scanner->seen;

    if (!counts.packets)
        counts.text_bytes += text_bytes(scanner->run, scanner->partial);
    scanner->told = counts;
    return &scanner->told;
}

size_t scanner_samples(const struct scanner_packet *packet)
{
    size_t head_size = packet->type == TP_SAMPLES ? sizeof(struct tp_samples) : sizeof(struct tp_packed), count = 0;
    struct tp_packed head;

    if (packet->size < head_size)
        return 0;
    size_t size = packet->size - head_size;
    memcpy(&head, packet->payload, head_size);
    if (packet->type == TP_SAMPLES && size % 2 == 0)
        count = size / 2;
    else if (packet->type == TP_PACKED && size % 3 != 1 && head.step >= 1 && head.step <= TP_PACKED_MOST_STEP &&
             head.base + MOST_PACKED * head.step <= INT16_MAX)
        count = size / 3 * 2 + size % 3 / 2;
    return count > TP_MAX_SAMPLES ? 0 : count;
}

static void put(uint8_t *to, uint16_t word)
{
    memcpy(to, &word, sizeof word);
}

static void copy_unpacked(const uint8_t *from, size_t size, uint8_t *to)
{
    for (; size; size--, from += 2, to += 2) {
        uint16_t word;
        memcpy(&word, from, sizeof word);
        put(to, word ^ TP_SAMPLE_XOR);
    }
}

static void copy_packed(const uint8_t *from, size_t size, int32_t base, int32_t step, uint8_t *to)
{
    for (; size > 1; size -= 2, from += 3, to += 4) {
        int32_t a = from[0] | (from[1] & 15) << 8, b = from[1] >> 4 | from[2] << 4;
        put(to, (uint16_t)(base + step * (a ^ PACKED_XOR)));
        put(to + 2, (uint16_t)(base + step * (b ^ PACKED_XOR)));
    }
    if (size) {
        int32_t last = from[0] | (from[1] & 15) << 8;
        put(to, (uint16_t)(base + step * (last ^ PACKED_XOR)));
    }
}

void scanner_copy_samples(const struct scanner_packet *packet, struct tp_samples *head, void *counts)
{
    struct tp_packed packed;
    size_t size = scanner_samples(packet);

    memcpy(head, packet->payload, sizeof *head); /* that of packed ones begins alike */
    if (packet->type == TP_SAMPLES) {
        copy_unpacked(packet->payload + sizeof *head, size, counts);
        return;
    }
    memcpy(&packed, packet->payload, sizeof packed);
    copy_packed(packet->payload + sizeof packed, size, packed.base, packed.step, counts);
}

static void read_quiet(const struct scanner_packet *packet, struct scanner_content *content)
{
    struct tp_quiet quiet;

    memcpy(&quiet, packet->payload, sizeof quiet);
    uint64_t count = content->count = quiet.count, squares = quiet.sum_of_squares;
    uint64_t size = quiet.sum < 0 ? 0 - (uint64_t)quiet.sum : (uint64_t)quiet.sum;
    content->is_exact = false;
    if (!count || count >> 26 || size >> 31 || squares >= LARGEST_EXACT * 1024 / count)
        return;
    int64_t spread = (int64_t)(count * squares) - (int64_t)(size * size);
    content->is_exact = spread >= 0 && (uint64_t)spread < LARGEST_EXACT;
    content->mean = (double)quiet.sum / (double)count;
    content->variance = (double)spread / ((double)count * (double)count);
}

bool scanner_read(const struct scanner_packet *packet, struct scanner_content *content)
{
    struct tp_samples head; /* a quiet packet begins alike, too */
    bool quiet = packet->type == TP_QUIET;
    size_t count = scanner_samples(packet);

    if (quiet ? packet->size != sizeof(struct tp_quiet) : !count)
        return false;
    if (!quiet)
        scanner_copy_samples(packet, &head, content->counts);
    memcpy(&head, packet->payload, sizeof head);
    content->first_index = head.first_index;
    content->device_us = head.device_time_us;
    content->count = (uint32_t)count;
    content->sequence = packet->sequence;
    content->sync = head.flags & TP_FLAG_SYNC;
    content->asked = head.flags & TP_FLAG_ASKED;
    content->turn = (uint8_t)(head.flags >> TP_TURN_SHIFT);
    content->quiet = quiet;
    if (quiet)
        read_quiet(packet, content);
    return true;
}
