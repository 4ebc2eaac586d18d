// Copyright 2026 tactile_cdma maintainers
//
// Licensed under the Apache License, Version 2.0 (the "License");
// you may not use this file except in compliance with the License.
// You may obtain a copy of the License at
//
//     http://www.apache.org/licenses/LICENSE-2.0
//
// Unless required by applicable law or agreed to in writing, software
// distributed under the License is distributed on an "AS IS" BASIS,
// WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
// See the License for the specific language governing permissions and
// limitations under the License.

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
