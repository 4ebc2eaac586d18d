// An RP2040 as rp2040js emulates it, corrected where the digitizer depends on a difference from the chip.
// Each correction says what the emulator does.

import { RP2040 } from 'rp2040js';

import { boot, fillWithRubbish, hideFlash, startCrystalSlowly } from './rp2040_powerup.mjs';

const BOOT_STAGE_ADDRESS = 0x20041f00; // where the boot ROM loads it
const PSM_ALL_BUT_OSCILLATORS = 0x1fffc;
const RESET_ADC = 1 << 0;
const RESET_PIO0 = 1 << 10;
const RESET_PWM = 1 << 14;
const PIO_CTRL = 0x00;
const PIO_OUT_OF_RESET = { pc: 0, waiting: false, outputShiftCount: 32, x: 0, y: 0 };
const JMP_X_DEC = 0x0040;
const ROM = { 0x14: 0x100, 0x18: 0x201, 0x200: 0x4770be00, 0x300: 0xe7febe01 }; // bkpt 0, bx lr; bkpt 1, b .
const ROM_FUNCTIONS = 0x100;
const ROM_RESET_TO_USB = 0x301;
const SUPPLY_V = 3.3;
const COUNTS = 4096;
const PIN_LINE = 26;
const LINE_OHMS = 1e3; // from the amplifier to the converter; chosen: boards have 1 to 2 kΩ
const PULL_OHMS = 60e3; // of a pad, 50 to 80 kΩ
const PULLED_V = { 3: SUPPLY_V, 4: 1e-9 }; // by the state of a released pin: pulled up, or down
const SYNC_PIN = 16;
const RECOVERY_NS = 4500; // of a line that was pulled low: within 1 mV after 33 µs (SPICE, 4 nF)
const DREQ_UART0_TX = 20;
const PWM_DIV = 0x04;
const DMA_CHAN_ABORT = 0x444;
const UART_BAUD = 2e6;
const UART_FIFO = 32;
const UART_CR = 0x30;
const UART_RX = 1 << 4; // of its interrupts: many bytes have come
const UART_RT = 1 << 6; // some have, and no others since
const UART_RX_MANY = 16; // by default half of the FIFO
const UART_RX_BITS = 32; // after which it tells of fewer
const UART_DMACR = 0x48;
const INTERRUPT_CYCLES = 15 + 13; // entry and return, which take no time in the emulator

export class Chip {
  // image: content of the flash. flashId: its unique number, 8 bytes. line: time in ns → ADC count;
  // or a network, as rp2040.mjs describes it, which the chip's own pins drive.
  // uartByte: called with every byte that UART0 sends, at the end of its stop bit. grounded: pins tied to ground.
  constructor({ image, flashId, line, uartByte, grounded = [] }) {
    this.rp2040 = new RP2040();
    this.clock = this.rp2040.clock;
    this.rp2040.logger = new Logger();
    this.cycles = 0; // in which the CPU was awake
    this.stalledUntil = 0;
    fillWithRubbish(this.rp2040.sram, this.rp2040.usbDPRAM);
    this.#countInterruptCycles();
    this.#sleepWithInterruptsOff();
    this.#resetBlocks();
    this.#stopPwm();
    this.#abortDma();
    this.#clockPio();
    this.#hearPins(grounded);
    this.#standInForRom();
    this.#connectLine(typeof line === 'function' ? amplified(line) : network(this.rp2040, line));
    this.#connectFlash(flashId);
    hideFlash(this.rp2040, image);
    startCrystalSlowly(this.rp2040);
    this.#paceUart(uartByte);
    const { [0x40010]: psm, [0x40058]: watchdog } = this.rp2040.peripherals;
    watchdog.onWatchdogTrigger = () => {
      const resets = psm.wdsel === PSM_ALL_BUT_OSCILLATORS ? 'has reset the chip' : 'resets nothing';
      throw new Error(`the watchdog ${resets} at ${this.now} ns`);
    };
    boot(this.rp2040, image, BOOT_STAGE_ADDRESS);
  }

  get now() {
    return this.clock.nanos;
  }

  // Advances by instructions of the CPU or, while it sleeps, from alarm to alarm.
  run(until) {
    const { clock, rp2040 } = this;
    const { core } = rp2040;
    if (this.isDrive) clock.tick(until - clock.nanosCounter);
    while (clock.nanosCounter < until && !this.isDrive) {
      // The emulator misses an interrupt that comes between its last check and WFI.
      if (core.waiting && core.pendingInterrupts & core.enabledInterrupts) core.waiting = false;
      if (core.waiting || clock.nanosCounter < this.stalledUntil) {
        const end = core.waiting ? until : Math.min(until, this.stalledUntil);
        const next = clock.nextAlarm ? clock.nextAlarm.nanos : Infinity;
        clock.tick(Math.min(next, end) - clock.nanosCounter);
        continue;
      }
      const cycles = core.executeInstruction() + this.interruptCycles;
      this.interruptCycles = 0;
      this.cycles += cycles;
      const time = clock.nanosCounter + (cycles * 1e9) / rp2040.clkSys;
      if (clock.nextAlarm && clock.nextAlarm.nanos <= time) clock.tick(time - clock.nanosCounter);
      else clock.nanosCounter = time;
    }
  }

  // Stalls the CPU, while everything else continues.
  stall(ns) {
    this.stalledUntil = this.now + ns;
  }

  // From a time on, something outside the chip has a pin that it does not drive high or low.
  drive(pin, time, high) {
    this.clock.createAlarm(() => this.rp2040.gpio[pin].setInputValue(high)).schedule(time - this.clock.nanosCounter);
  }

  // Keeps the DMA from taking samples out of the ADC's FIFO for a time.
  holdSamples(ns) {
    const { adc, dma } = this.rp2040;
    const update = adc.updateDMA;
    adc.updateDMA = () => dma.clearDREQ(adc.dreq);
    adc.updateDMA();
    this.clock
      .createAlarm(() => {
        adc.updateDMA = update;
        adc.updateDMA();
      })
      .schedule(ns);
  }

  // Time before which the sync line will not change: that of PWM 0's next event in its present period.
  get syncStaysUntil() {
    const { timer, alarmA, alarmBottom } = this.rp2040.pwm.channels[0];
    if (!timer.enable) return this.now;
    return Math.min(alarmA.clockAlarm.nanos, alarmBottom.clockAlarm.nanos);
  }

  // changed: called with 0 (driven low), 1 (driven high) or 2 (released).
  onPin(pin, changed) {
    let level = 2;
    this.rp2040.gpio[pin].addListener((state) => {
      if (level !== Math.min(state, 2)) changed((level = Math.min(state, 2)));
    });
  }

  #countInterruptCycles() {
    const { core } = this.rp2040;
    const enter = core.exceptionEntry.bind(core);
    this.interruptCycles = 0;
    core.exceptionEntry = (number) => {
      this.interruptCycles += INTERRUPT_CYCLES;
      enter(number);
    };
  }

  // An emulated WFI with interrupts off takes the one that ends it, and no other can come before that one is over.
  // The chip goes on with the next instruction.
  #sleepWithInterruptsOff() {
    const { core } = this.rp2040;
    const check = core.checkForInterrupts.bind(core);
    core.checkForInterrupts = () => {
      if (!core.waiting || !core.PM) return check();
      core.waiting = !(core.pendingInterrupts & core.enabledInterrupts);
      return false;
    };
  }

  // Emulated RESETS reset nothing, so a conversion in progress, old samples or half a pulse would
  // reach the next stream.
  #resetBlocks() {
    const { adc, pwm, peripherals } = this.rp2040;
    const resets = peripherals[0x4000c];
    const write = resets.writeUint32.bind(resets);
    resets.writeUint32 = (offset, value) => {
      write(offset, value);
      if (offset !== 0) return;
      if (value & RESET_ADC) {
        adc.sampleAlarm.cancel();
        adc.multiShotAlarm.cancel();
        adc.fifo.reset();
        adc.busy = false;
        adc.cs = adc.fcs = adc.clockDiv = 0;
        this.rp2040.dma.clearDREQ(adc.dreq);
      }
      if (value & RESET_PWM) {
        pwm.reset();
        pwm.gpioValue = pwm.intRaw = pwm.intEnable = 0;
        pwm.checkInterrupts();
      }
      if (value & RESET_PIO0) {
        const pio = this.rp2040.pio[0];
        pio.writeUint32(PIO_CTRL, 0);
        pio.fdebug = pio.txStall = pio.pinValues = pio.pinDirections = 0;
        for (const machine of pio.machines) {
          Object.assign(machine, PIO_OUT_OF_RESET);
          machine.txFIFO.reset();
          machine.updateDMATx();
        }
        pio.checkChangedPins();
      }
    };
  }

  // An emulated state machine runs in bursts that take no time, and the clock does not know of it. Here
  // every instruction is an alarm of the clock, at clk_sys; one that waits, or that has counted down to
  // itself, is one alarm.
  #clockPio() {
    for (const pio of this.rp2040.pio) {
      pio.run = () => {};
      for (const machine of pio.machines) {
        const period = () => 1e9 / this.rp2040.clkSys;
        let stepping = false;
        const alarm = this.clock.createAlarm(() => {
          const { cycles, pc } = machine;
          stepping = true;
          if (pio.instructions[pc] === (JMP_X_DEC | pc)) {
            machine.cycles += machine.x + 1;
            machine.x = 0xffffffff;
            machine.nextPC();
          } else {
            machine.step();
          }
          stepping = false;
          pio.checkChangedPins();
          if (!machine.waiting) alarm.schedule((machine.cycles - cycles) * period());
        });
        const check = machine.checkWait.bind(machine);
        machine.checkWait = () => {
          const waited = machine.waiting;
          check();
          if (waited && !machine.waiting && !stepping) alarm.schedule(period());
        };
        let enabled = false;
        Object.defineProperty(machine, 'enabled', {
          get: () => enabled,
          set: (on) => {
            if (on && !enabled) alarm.schedule(period());
            if (!on) alarm.cancel();
            enabled = on;
          },
        });
      }
    }
  }

  // There is no boot ROM. This has its function table with one entry, by which the image asks to restart as
  // a USB drive; then the processor does no more.
  #standInForRom() {
    const { bootrom, core } = this.rp2040;
    for (const [address, word] of Object.entries(ROM)) bootrom[address / 4] = word;
    this.isDrive = false;
    this.rp2040.onBreak = (number) => {
      const [table, code] = core.registers;
      if (number) this.isDrive = true;
      else core.registers[0] = table === ROM_FUNCTIONS && code === 0x4255 ? ROM_RESET_TO_USB : 0;
    };
  }

  // Emulated inputs see neither what their own pins put out nor pull-ups. grounded: pins that are tied to ground.
  #hearPins(grounded) {
    for (const [number, pin] of this.rp2040.gpio.entries())
      pin.addListener((state) => pin.setInputValue(!grounded.includes(number) && (state === 1 || state === 3)));
  }

  // An emulated slice starts counting when its divider is set, even if it is not enabled.
  #stopPwm() {
    const slice = this.rp2040.pwm.channels[0];
    const write = slice.writeRegister.bind(slice);
    slice.writeRegister = (offset, value) => {
      write(offset, value);
      if (offset === PWM_DIV) slice.updateEnable();
    };
  }

  // Emulated DMA aborts a transfer at once, but lacks the register that shows the end of it.
  #abortDma() {
    const { dma } = this.rp2040;
    const read = dma.readUint32.bind(dma);
    dma.readUint32 = (offset) => (offset === DMA_CHAN_ABORT ? 0 : read(offset));
  }

  // The emulator's pacing is correct: a conversion takes 96 clocks, and the next one begins
  // 1 + DIV.INT clocks after the previous one. An emulated converter's pin has no pulls.
  #connectLine(line) {
    const { adc, gpio } = this.rp2040;
    const pulledTo = () => PULLED_V[gpio[PIN_LINE].pullupEnabled ? 3 : gpio[PIN_LINE].pulldownEnabled ? 4 : 0];
    adc.onADCRead = (channel) => {
      const { divider } = adc;
      adc.currentChannel = channel;
      adc.channelValues[channel] = line(this.now, (Math.max(divider, 96) * 1000) / 48, pulledTo());
      adc.sampleAlarm.schedule(adc.sampleTime * 1000);
    };
  }

  // The emulated SSI reads zeros and has no flash pins. This is a flash chip with one command: read
  // unique number.
  #connectFlash(flashId) {
    const { peripherals } = this.rp2040;
    const ssi = peripherals[0x18000];
    const pins = peripherals[0x40018];
    const [write, read] = [ssi.writeUint32.bind(ssi), ssi.readUint32.bind(ssi)];
    let selected = 0;
    let received = [];
    let answer = [];
    pins.readUint32 = () => 0;
    pins.writeUint32 = (offset, value) => {
      if (offset !== 0x0c) return;
      selected = ((value >> 8) & 3) === 2; // OUTOVER: low
      received = [];
    };
    ssi.writeUint32 = (offset, value) => {
      if (offset !== 0x60) return write(offset, value);
      const place = received.push(value & 0xff) - 6; // after the command and 4 dummy bytes
      answer.push(selected && received[0] === 0x4b && place >= 0 ? flashId[place] : 0);
    };
    ssi.readUint32 = (offset) => (offset === 0x60 ? answer.shift() : read(offset));
  }

  // Emulated bytes leave the UART at once, and DMA may always write the next. Here they wait in the FIFO
  // and take their time on the wire.
  #paceUart(uartByte) {
    const uart = this.rp2040.uart[0];
    const { dma } = this.rp2040;
    const write = uart.writeUint32.bind(uart);
    const queue = [];
    let byDma = false;
    const request = () => {
      if (byDma && uart.enabled && queue.length < UART_FIFO) dma.setDREQ(DREQ_UART0_TX);
      else dma.clearDREQ(DREQ_UART0_TX);
    };
    const sent = this.clock.createAlarm(() => {
      uartByte(queue.shift());
      if (queue.length) sent.schedule(this.uartByteNs);
      request();
    });
    uart.onByte = (byte) => {
      if (queue.push(byte) === 1) sent.schedule(this.uartByteNs);
      request();
    };
    uart.writeUint32 = (offset, value) => {
      if (offset === UART_DMACR) byDma = (value & 2) !== 0;
      else write(offset, value);
      if (offset === UART_DMACR || offset === UART_CR) request();
    };

    // An emulated UART interrupts at every byte.
    const { rxFIFO } = uart;
    const read = uart.readUint32.bind(uart);
    const level = () => {
      uart.interruptStatus &= ~UART_RX;
      if (rxFIFO.itemCount >= UART_RX_MANY) uart.interruptStatus |= UART_RX;
      if (rxFIFO.empty) uart.interruptStatus &= ~UART_RT;
      uart.checkInterrupts();
    };
    const waited = this.clock.createAlarm(() => {
      if (!rxFIFO.empty) uart.interruptStatus |= UART_RT;
      uart.checkInterrupts();
    });
    uart.readUint32 = (offset) => {
      const value = read(offset);
      if (offset === 0) level();
      return value;
    };
    const arriving = [];
    const arrived = this.clock.createAlarm(() => {
      uart.feedByte(arriving.shift());
      level();
      waited.schedule((this.uartByteNs / 10) * UART_RX_BITS);
      if (arriving.length) arrived.schedule(this.uartByteNs);
    });
    this.uartReceive = (bytes) => {
      const idle = !arriving.length;
      arriving.push(...bytes);
      if (idle && arriving.length) arrived.schedule(this.uartByteNs);
    };
  }

  get uartByteNs() {
    const { baudRate } = this.rp2040.uart[0];
    if (Math.abs(baudRate / UART_BAUD - 1) > 0.02)
      throw new Error(`UART0 is set to ${baudRate} baud, its host to ${UART_BAUD}`);
    return 10e9 / baudRate;
  }
}

// The line behind an amplifier, whose resistor a pull of the converter's pin makes a divider of.
function amplified(line) {
  return (now, period, pulledTo) => {
    const count = line(now, period);
    if (pulledTo === undefined) return count;
    return Math.round(count + ((pulledTo / SUPPLY_V) * COUNTS - count) * (LINE_OHMS / (LINE_OHMS + PULL_OHMS)));
  };
}

// The line that pins drive through resistors: a count of the ADC by the network's voltage, with noise.
// pull_ohms: of a transistor to ground whose gate is the sync pin, or null; after it the line comes back.
function network({ gpio }, { ohms, bias_ohms, noise_counts, pull_ohms }) {
  let seed = 1;
  const random = () => (seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0) / 2 ** 32 - 0.5;
  let left = 0; // of what the transistor did to the line
  let before = 0;
  return (now, _period, pulledTo) => {
    let siemens = 2 / bias_ohms + (pulledTo === undefined ? 0 : 1 / PULL_OHMS);
    let amperes = SUPPLY_V / bias_ohms + (pulledTo ?? 0) / PULL_OHMS;
    for (const [pin, resistor] of ohms.entries()) {
      if (resistor === null) continue;
      const { value } = gpio[pin];
      if (value > 1 && !PULLED_V[value]) continue; // released: no current
      const conductance = 1 / (resistor + (value > 1 ? PULL_OHMS : 0));
      siemens += conductance;
      amperes += conductance * (value > 1 ? PULLED_V[value] : value * SUPPLY_V);
    }
    const pulled = pull_ohms !== null && gpio[SYNC_PIN].value === 1;
    const low = amperes / (siemens + 1 / pull_ohms);
    left = pulled ? 1 : left * Math.exp((before - now) / RECOVERY_NS);
    before = now;
    const volts = left ? low * left + (amperes / siemens) * (1 - left) : amperes / siemens;
    // the sum of 12 has a variance of 1
    let noise = 0;
    for (let i = 0; i < 12; i++) noise += random();
    const count = (volts / SUPPLY_V) * COUNTS + noise * noise_counts;
    return Math.min(Math.max(Math.floor(count), 0), COUNTS - 1);
  };
}

// The emulator reports what it cannot do. For this firmware all of it would be an error.
class Logger {
  debug() {}
  info() {}
  warn(component, message) {
    this.error(component, message);
  }
  error(component, message) {
    throw new Error(`${component}: ${message}`);
  }
}
