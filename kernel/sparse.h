// SPDX-License-Identifier: Apache-2.0

/* Chips of a frame of sparse codes → its words and their certificate: as certificate.h, with the same limits.
 *
 * What is left needs not be read early or late: a node that is late, or flips its chips otherwise, leaves noise of its
 * power A², as codes are scrambled. If less is left than noise and A², there is none. What clauses say here:
 *
 * ENERGY: as in certificate.h; and noise of a bit must be less than what is left where a word is lost. ATOMS, REST:
 * 0. A silent node's row that holds more than noise makes its silence doubtful. RIVALS: codes of those who speak may
 * add up to nothing in a bit: then other bits give the same chips. WORDS: words were found that stayed the same, of
 * no more nodes than are told apart, and not all of them faint. */
#ifndef TACTILE_SPARSE_H
#define TACTILE_SPARSE_H

#include "certificate.h"
#include "detect.h"

struct sparse;

/* As certifier_new; NULL also if the book is none of its transform, or of so many nodes. */
struct sparse *sparse_new(const struct code *code, const struct certificate_limits *limits, const float *expected);
void sparse_free(struct sparse *sparse);

/* As certifier_read. Of a frame without words that stayed the same, as many nodes spoke as have its power. */
void sparse_read(struct sparse *sparse, const struct certificate_view *view, const struct words *words,
                 struct certificate *certificate);

#endif
