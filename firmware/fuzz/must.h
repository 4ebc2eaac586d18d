// SPDX-License-Identifier: Apache-2.0

/* What the firmware must do: a harness that finds otherwise says what kind of fault that is, as the
 * sums of `make torture` have them, and ends. */
#ifndef FUZZ_MUST_H
#define FUZZ_MUST_H

#include <stdio.h>
#include <stdlib.h>

enum fault { WRONG_VALUE, UNCOUNTED_LOSS };

#define MUST(condition, fault)                                                         \
    do {                                                                               \
        if (!(condition)) {                                                            \
            fprintf(stderr, "%s:%d: %s: %s\n", __FILE__, __LINE__,                     \
                    (fault) == WRONG_VALUE ? "wrong value" : "uncounted loss", #condition); \
            abort();                                                                   \
        }                                                                              \
    } while (0)

#endif
