/* Second boot stage: the boot ROM loads the first 256 bytes of the flash, checks their CRC (made by
 * image.py) and calls them. They set the flash up for plain serial reads (command 03h), which every
 * flash chip supports and which are fast enough, because code is copied to RAM before it runs. */
    .syntax unified
    .cpu cortex-m0plus
    .thumb
    .section .boot2, "ax"

    ldr  r3, =0x18000000        /* SSI */
    movs r0, #0
    str  r0, [r3, #0x08]        /* SSIENR: off while it is set up */
    movs r0, #4
    str  r0, [r3, #0x14]        /* BAUDR: clk_sys / 4 */
    ldr  r0, =(31 << 16 | 3 << 8)
    str  r0, [r3, #0x00]        /* CTRLR0: one bit wide, words of 32, command then data */
    movs r0, #0
    str  r0, [r3, #0x04]        /* CTRLR1: one word per access */
    ldr  r0, =(0x03 << 24 | 2 << 8 | 6 << 2)
    ldr  r1, =0x180000f4
    str  r0, [r1]               /* SPI_CTRLR0: command 03h of 8 bits, address of 24 */
    movs r0, #1
    str  r0, [r3, #0x08]

    ldr  r0, =0x10000100        /* the vectors in flash */
    ldr  r1, =0xe000ed08        /* VTOR */
    str  r0, [r1]
    ldm  r0!, {r1, r2}
    msr  msp, r1
    bx   r2
    .ltorg
