// SPDX-License-Identifier: Apache-2.0

/* How the compiler is told to compute many values at once.
 *
 * A VECTORS function is compiled for AVX2 besides what every processor has, and chosen when the module is
 * loaded; what it inlines is compiled with it. Each value goes through the same operations in the same
 * order either way, so that every processor gives the same bits. */
#ifndef TACTILE_VECTORS_H
#define TACTILE_VECTORS_H

#include <stddef.h> /* says which C library this is: only glibc's loader chooses */
#include <stdint.h>

#define INLINE static inline __attribute__((always_inline))

/* Values of an array, of any alignment, that go through the same operations at once. Sums in arrays of as many
 * floats would do the same, but compilers take those apart. */
typedef float floats4 __attribute__((vector_size(16), aligned(4), may_alias));
typedef float floats8 __attribute__((vector_size(32), aligned(4), may_alias));
typedef int32_t ints1 __attribute__((may_alias)); /* the bits of a float */
typedef int32_t ints8 __attribute__((vector_size(32), aligned(4), may_alias));
typedef double doubles4 __attribute__((vector_size(32), aligned(8), may_alias));

/* Before a loop whose arrays differ, where `restrict` is not enough: there are many of them. */
#if defined(__clang__)
#define APART _Pragma("clang loop vectorize(assume_safety)")
#pragma clang diagnostic ignored "-Wpass-failed" /* a sanitizer keeps loops as they are */
#elif defined(__GNUC__)
#define APART _Pragma("GCC ivdep")
#else
#define APART
#endif

/* Not with clang: its linker symbol of such a function is another one before clang 17. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__gnu_linux__)
#define VECTORS __attribute__((target_clones("avx2", "default")))
#else
#define VECTORS
#endif

#endif
