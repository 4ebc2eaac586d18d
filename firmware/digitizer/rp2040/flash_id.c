// SPDX-License-Identifier: Apache-2.0

/* Reads the flash chip's unique number, used as the board's id: the RP2040 itself has none. */
#include "registers.h"
#include "rp2040.h"

#define READ_UNIQUE_ID 0x4b
#define DUMMY_BYTES 4u
#define ID_BYTES 8u

/* The flash cannot be read as memory meanwhile; all code is in RAM. */
void flash_id(uint8_t id[ID_BYTES])
{
    uint32_t ctrlr0 = SSI->ctrlr0;
    uint8_t all_ones = 0xff;

    SSI->ssienr = 0;
    SSI->ctrlr0 = SSI_CTRLR0_8_BITS;
    SSI->ssienr = 1;
    IO_QSPI->io[IO_QSPI_SS].ctrl = IO_OUTOVER_LOW;
    for (size_t i = 0; i < 1 + DUMMY_BYTES + ID_BYTES; i++) { /* 13 bytes; the FIFOs hold 16 */
        SSI->dr0 = i ? 0 : READ_UNIQUE_ID;
        while (!(SSI->sr & SSI_SR_RFNE_BITS))
            ;
        uint8_t byte = (uint8_t)SSI->dr0;
        if (i > DUMMY_BYTES) {
            id[i - 1 - DUMMY_BYTES] = byte;
            all_ones &= byte;
        }
    }
    IO_QSPI->io[IO_QSPI_SS].ctrl = 0;
    SSI->ssienr = 0;
    SSI->ctrlr0 = ctrlr0;
    SSI->ssienr = 1;
    for (size_t i = 0; all_ones == 0xff && i < ID_BYTES; i++)
        id[i] = 0; /* no answer */
}
