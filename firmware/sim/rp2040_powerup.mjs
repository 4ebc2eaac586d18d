// What an RP2040 is like at power-up, where the emulator is kinder than the chip: memory full of zeros, a flash
// that can be read at once, a crystal that needs no time, a UART that tells of every byte.

const FLASH_BOOT_STAGE = 256;
const SSI = { ctrlr0: 0x00, ctrlr1: 0x04, enable: 0x08, baudr: 0x14, spi_ctrlr0: 0xf4 };
const READ_DATA = 0x03; // command of every serial flash: then come an address of 24 bits and the data
const XOSC_STARTUP = 0x0c;
const CLK_REF_CTRL = 0x30;
const XOSC_HZ = 12e6;
const CRYSTAL_S = 0.064; // what pico-sdk allows for the slowest crystal of the boards that it knows

// Fills memories with numbers that look like any, the same at every start.
export function fillWithRubbish(...memories) {
  let seed = 1;
  for (const memory of memories) {
    for (let i = 0; i < memory.length; i++) {
      seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
      memory[i] = seed >>> 24;
    }
  }
}

// The flash's content can be read once the SSI is enabled with a set-up for its read command.
export function hideFlash({ flash, peripherals }, image) {
  const ssi = peripherals[0x18000];
  const write = ssi.writeUint32.bind(ssi);
  const registers = {};
  flash.fill(0, 0, image.length); // of a bus that nothing drives
  ssi.writeUint32 = (offset, value) => {
    registers[offset] = value;
    if (offset === SSI.enable && value && reads(registers)) flash.set(image);
    write(offset, value);
  };
}

// Whether a word is read by the command, 24 bits of address and 32 of data, all on one wire, at clk_sys / 4 or
// slower (data sheet of the RP2040, 4.10.13; those of flash chips: 33 MHz and more).
function reads(registers) {
  const ctrlr0 = registers[SSI.ctrlr0];
  const spi = registers[SSI.spi_ctrlr0];
  return (
    ((ctrlr0 >> 16) & 31) === 31 && // DFS_32
    ((ctrlr0 >> 21) & 3) === 0 && // SPI_FRF: one wire
    ((ctrlr0 >> 8) & 3) === 3 && // TMOD: command and address, then data
    registers[SSI.ctrlr1] === 0 &&
    registers[SSI.baudr] >= 4 &&
    spi >>> 24 === READ_DATA &&
    ((spi >> 11) & 31) === 0 && // WAIT_CYCLES
    ((spi >> 8) & 3) === 2 && // INST_L: 8 bits
    ((spi >> 2) & 15) === 24 / 4 && // ADDR_L
    (spi & 3) === 0 // TRANS_TYPE
  );
}

// Refuses to run from a crystal that was not given the time to start.
export function startCrystalSlowly({ peripherals }) {
  const { [0x40024]: xosc, [0x40008]: clocks } = peripherals;
  const write = clocks.writeUint32.bind(clocks);
  clocks.writeUint32 = (offset, value) => {
    const seconds = ((xosc.startup & 0x3fff) * 256) / XOSC_HZ;
    if (offset === CLK_REF_CTRL && (value & 3) === 2 && seconds < CRYSTAL_S)
      throw new Error(`the crystal has ${seconds * 1e3} ms to start, slow ones need ${CRYSTAL_S * 1e3}`);
    write(offset, value);
  };
}

// Boots as the ROM does: into the first 256 bytes of the flash, copied to the address that it has for them.
export function boot({ core, sram }, image, address) {
  sram.set(image.subarray(0, FLASH_BOOT_STAGE), address - 0x20000000);
  core.SP = 0x20042000;
  core.PC = address;
}
