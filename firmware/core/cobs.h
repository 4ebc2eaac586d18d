// SPDX-License-Identifier: Apache-2.0

/* COBS: bytes without any zero, so that a zero can end a packet. See docs/protocol.md.
 *
 * Both directions work on the way: the encoder in a ring of bytes, the decoder byte by byte. So a
 * packet of any length needs no memory of its own.
 */
#ifndef TACTILE_COBS_H
#define TACTILE_COBS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Most bytes that `size` ≥ 1 bytes become. */
#define COBS_MAX(size) ((size) + ((size) + 253) / 254)

struct cobs_encoder {
    uint8_t *ring;
    size_t size;   /* of the ring */
    size_t next;   /* where the next byte goes */
    size_t block;  /* where the length of the open block goes */
    size_t length; /* of the open block so far, 1…255 */
};

/* From place `begin` of a ring on. There must be room for all that comes. */
void cobs_begin(struct cobs_encoder *encoder, uint8_t *ring, size_t size, size_t begin);
void cobs_put(struct cobs_encoder *encoder, const void *bytes, size_t size);
/* Ends the data, with a zero. Returns where in the ring the next packet may begin. */
size_t cobs_end(struct cobs_encoder *encoder);

/* All zero at the start of a run of bytes. */
struct cobs_decoder {
    uint8_t left; /* bytes of the open block to come */
    bool zero;    /* another block would come after a zero */
};

/* The next byte, none of them zero. Returns whether it gave a byte of data, `decoded`. */
bool cobs_decode(struct cobs_decoder *decoder, uint8_t byte, uint8_t *decoded);
/* Whether the bytes so far are COBS. */
bool cobs_whole(const struct cobs_decoder *decoder);

#endif
