// SPDX-License-Identifier: Apache-2.0

/* Arbitrary bytes through the core's reader and a reference reader; packets of any size from the core's
 * writer, across any end of its ring. */
#include "packet.h"
#include "reference.h"

#define MOST_ROOM 3000

/* The core must find the same packets as the reference. */
static void read(const uint8_t *bytes, size_t size)
{
    static uint8_t body[FRAMING_MAX_RUN];
    struct packet_reader reader = {0};
    uint32_t errors = 0;
    size_t begin = 0;

    for (size_t i = 0; i < size; i++) {
        bool whole = packet_read(&reader, bytes[i]);
        if (bytes[i]) {
            MUST(!whole, WRONG_VALUE);
            continue;
        }
        size_t body_size = framing_unwrap(bytes + begin, i - begin, body);
        errors += !body_size && i > begin;
        begin = i + 1;
        MUST(whole == (body_size > 0), WRONG_VALUE);
        MUST(reader.errors == errors, UNCOUNTED_LOSS);
        if (!whole)
            continue;
        size_t kept = body_size - sizeof reader.header;
        MUST(reader.payload_size == kept, WRONG_VALUE);
        kept = kept < PACKET_KEPT ? kept : PACKET_KEPT;
        MUST(!memcmp(&reader.header, body, sizeof reader.header), WRONG_VALUE);
        MUST(!memcmp(reader.payload, body + sizeof reader.header, kept), WRONG_VALUE);
    }
}

/* Takes the content of the ring, which must be this packet, or empty without one. */
static void take(struct packet_writer *writer, const uint8_t *wire, size_t size)
{
    const uint8_t *bytes;
    size_t taken = 0;

    for (size_t some; (some = packet_output(writer, &bytes)) != 0; taken += some) {
        MUST(taken + some <= size && !memcmp(bytes, wire + taken, some), WRONG_VALUE);
        packet_sent(writer, some);
    }
    MUST(taken == size, WRONG_VALUE);
}

/* Packets of the input through a ring of a size of its own. */
static void write(struct input *input)
{
    static uint8_t wire[TP_MAX_PACKET], body[MOST_ROOM + 16];
    size_t room = 16 + input_u16(input) % MOST_ROOM;
    uint8_t *ring = malloc(room);
    struct packet_writer writer;
    struct tp_header header = {0, 0};
    uint32_t dropped = 0;

    packet_writer_init(&writer, ring, room);
    take(&writer, (const uint8_t *)"", 1);
    while (input->left) {
        const uint8_t *payload;
        size_t reserve = input_u8(input), piece = 1 + input_u8(input);
        header.type = input_u8(input);
        size_t size = input_bytes(input, &payload, input_u16(input) % (MOST_ROOM - 16));
        bool fits = PACKET_MAX(size) + reserve <= room;
        MUST(packet_open(&writer, header.type, size, reserve) == fits, UNCOUNTED_LOSS);
        dropped += !fits;
        if (fits) {
            for (size_t i = 0; i < size; i += piece)
                packet_put(&writer, payload + i, size - i < piece ? size - i : piece);
            packet_close(&writer);
            memcpy(body, &header, sizeof header);
            memcpy(body + sizeof header, payload, size);
            take(&writer, wire, framing_wrap(body, sizeof header + size, wire));
        }
        header.sequence++;
    }
    MUST(writer.dropped == dropped, UNCOUNTED_LOSS);
    free(ring);
}

/* The input's first byte selects the test. */
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    static uint8_t wire[TP_MAX_PACKET], body[MOST_ROOM + 16];
    struct input input = {bytes, size};

    switch (input_u8(&input) % 3) {
    case 0:
        read(input.bytes, input.left);
        break;
    case 1:
        size = input_bytes(&input, &bytes, MOST_ROOM);
        memcpy(body, bytes, size);
        size = framing_wrap(body, size, wire);
        read(wire, size);
        break;
    case 2:
        write(&input);
        break;
    }
    return 0;
}
