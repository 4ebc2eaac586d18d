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

/* CRC-32 of IEEE 802.3, zlib and PNG. */
#ifndef TACTILE_CRC32_H
#define TACTILE_CRC32_H

#include <stddef.h>
#include <stdint.h>

/* The CRC of any bytes that are followed by their own CRC, low byte first. */
#define CRC32_RESIDUE 0x2144DF1Cu

/* The CRC of some bytes and `size` more; crc: of those before, 0 where there are none.
 *
 * With CRC32_SMALL defined, crc32.c does without its table: a tenth of the speed, but no kilobyte. */
uint32_t crc32_update(uint32_t crc, const void *bytes, size_t size);

#endif
