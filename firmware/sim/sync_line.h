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

/* The sync line: its edges, past and announced, in order. Every node reads it at its own pace. */
#ifndef SYNC_LINE_H
#define SYNC_LINE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct sync_edge {
    int64_t t_ns;
    bool level;
};

struct sync_line {
    struct sync_edge *edges;
    size_t size, capacity;
    uint64_t dropped; /* edges before edges[0]: those that all nodes have seen */
};

#endif
