// SPDX-License-Identifier: Apache-2.0

/* COBS (consistent overhead byte stuffing): encodes bytes so that none is zero and a zero can end a
 * packet. See docs/protocol.md.
 *
 * The encoder writes straight into a ring, the decoder works byte by byte, so neither buffers a
 * packet.
 */
#ifndef TACTILE_COBS_H
#define TACTILE_COBS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Upper bound of the encoded size of `size` ≥ 1 bytes. */
#define COBS_MAX(size) ((size) + ((size) + 253) / 254)

struct cobs_encoder {
    uint8_t *ring;
    size_t size;   /* of the ring */
    size_t next;   /* place of the next byte */
    size_t block;  /* place of the open block's length */
    size_t length; /* of the open block so far, 1…255 */
};

/* Starts at place `begin` of a ring. The caller sees to it that there is room. */
void cobs_begin(struct cobs_encoder *encoder, uint8_t *ring, size_t size, size_t begin);
void cobs_put(struct cobs_encoder *encoder, const void *bytes, size_t size);
/* Ends the data with a zero. Returns the place at which the next packet may begin. */
size_t cobs_end(struct cobs_encoder *encoder);

/* Zero-initialised at the start of each packet. */
struct cobs_decoder {
    uint8_t left; /* bytes still to come in the open block */
    bool zero;    /* a further block decodes to a zero first */
};

/* Takes the next byte, which is not zero. Returns true if it yields a data byte, then in *decoded. */
bool cobs_decode(struct cobs_decoder *decoder, uint8_t byte, uint8_t *decoded);
/* Whether the bytes so far are a complete COBS encoding. */
bool cobs_whole(const struct cobs_decoder *decoder);

#endif
