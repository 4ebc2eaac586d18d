// SPDX-License-Identifier: Apache-2.0

#include "cobs.h"

#define FULL 255 /* code of a block of 254 bytes that no zero follows */

static size_t after(const struct cobs_encoder *encoder, size_t place)
{
    return place + 1 == encoder->size ? 0 : place + 1;
}

static void open_block(struct cobs_encoder *encoder)
{
    encoder->block = encoder->next;
    encoder->next = after(encoder, encoder->next);
    encoder->length = 1;
}

static void close_block(const struct cobs_encoder *encoder)
{
    encoder->ring[encoder->block] = (uint8_t)encoder->length;
}

void cobs_begin(struct cobs_encoder *encoder, uint8_t *ring, size_t size, size_t begin)
{
    encoder->ring = ring;
    encoder->size = size;
    encoder->next = begin;
    open_block(encoder);
}

/* Copies up to `most` bytes, stopping at a zero; returns their number. The hot loop of a stream. */
static size_t copy_until_zero(uint8_t *to, const uint8_t *from, size_t most)
{
    size_t i = 0;

    while (i != most && from[i]) {
        to[i] = from[i];
        i++;
    }
    return i;
}

void cobs_put(struct cobs_encoder *encoder, const void *bytes, size_t size)
{
    const uint8_t *from = bytes, *end = from + size;

    while (from != end) {
        if (encoder->length == FULL) { /* not earlier: data that end here need no further block */
            close_block(encoder);
            open_block(encoder);
        }
        size_t most = FULL - encoder->length;
        if (most > (size_t)(end - from))
            most = (size_t)(end - from);
        if (most > encoder->size - encoder->next)
            most = encoder->size - encoder->next;
        size_t copied = copy_until_zero(encoder->ring + encoder->next, from, most);
        from += copied;
        encoder->length += copied;
        encoder->next += copied;
        if (encoder->next == encoder->size)
            encoder->next = 0;
        if (copied < most) {
            from++;
            close_block(encoder);
            open_block(encoder);
        }
    }
}

size_t cobs_end(struct cobs_encoder *encoder)
{
    close_block(encoder);
    encoder->ring[encoder->next] = 0;
    return after(encoder, encoder->next);
}

bool cobs_decode(struct cobs_decoder *decoder, uint8_t byte, uint8_t *decoded)
{
    if (decoder->left) {
        decoder->left--;
        *decoded = byte;
        return true;
    }
    bool zero = decoder->zero;
    decoder->left = (uint8_t)(byte - 1);
    decoder->zero = byte != FULL;
    *decoded = 0;
    return zero;
}

bool cobs_whole(const struct cobs_decoder *decoder)
{
    return decoder->left == 0;
}
