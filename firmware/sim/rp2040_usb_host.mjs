// A USB host for the emulated controller: enumerates the device as Linux does, then reads and writes its
// two bulk endpoints. It replaces the emulator's own transfers, which deliver at once whatever the host
// does and ignore data toggles. Where a device breaks a rule of USB 2.0, chapters 8 and 9, or of the controller's data
// sheet, it ends with an error.
//
// One transaction at a time is on the bus; 64 bytes take 1/19 ms, as full speed allows. Frames begin every
// 1 ms, and no transaction begins that would not end within its frame.
//
// A bus, if one is given, is like a real one: the host does not know when the device has a packet. It asks,
// the device declines (NAK), which takes time, and it asks again `retry_ns` later; between packets it takes
// `gap_ns`, as a hub does, and other devices have the first `busy` of each frame. Without one the host asks at
// once whenever there is a packet.

const SIE_BUS_RESET = 1 << 19;
const SIE_SUSPENDED = 1 << 4;
const FULL = 1 << 15;
const DATA1 = 1 << 13;
const STALL = 1 << 11;
const AVAILABLE = 1 << 10;
const RESET = 1 << 12;
const DOUBLE_BUFFERED = 1 << 30;
const LENGTH = 0x3ff;
const PACKET = 64;
const TRANSFER = 128; // bytes that Linux' CDC ACM driver reads at a time
const FRAME_NS = 1e6;
const LATE_NS = [810e3, 990e3]; // of a frame, in which RP2040-E15 forbids to offer a packet
const DEV_SOF = 1 << 17;
const SOF_RD = 0x48;
const SIE_STATUS = 0x50;
const IDLE_NS = 3e6; // of a bus without frames, after which a device takes it for suspended
const RESUME_NS = 20e6; // for which the host signals that it goes on
const IN = 0;
const OUT = 1;
const SETTLE_NS = 62.5; // 3 cycles of clk_usb, for which AVAILABLE has to come after the rest (data sheet, 4.1.2.5.1)
const MUXING = 0x74;
const PWR = 0x78;
const SIE_CTRL = 0x4c;
const TO_PHY = (1 << 0) | (1 << 3); // and SOFTCON
const VBUS_DETECTED = (1 << 2) | (1 << 3); // and its override, as boards have no pin for it
const PULL_UP = 1 << 16;
const TOKEN_NS = (37 * 1e3) / 12; // a pause and a token after a request, before the controller looks at its buffers
const NAK_NS = 6e3; // a token, the answer, and the pauses between them: 72 bit times
const TRANSACTION_NS = (bytes) => ((bytes + 15) * 8000) / 12;

const le16 = (value) => [value & 0xff, value >> 8];
const setup = (type, request, value, index, length) => [
  type,
  request,
  ...le16(value),
  ...le16(index),
  ...le16(length),
];

export class UsbHost {
  // received: called with the bytes of every transfer from the device; a transfer ends when it is full
  // or with a short packet.
  // enumerated: called with the device's descriptors.
  // bus: { retry_ns, gap_ns, busy }, or none.
  constructor(chip, { received, enumerated, bus }) {
    this.chip = chip;
    this.bus = bus;
    this.asks = this.naks = this.restsUntil = 0;
    this.usb = chip.rp2040.usbCtrl;
    this.view = chip.rp2040.usbDPRAMView;
    this.received = received;
    this.enumerated = enumerated;
    this.reading = false;
    this.toSend = [];
    this.plugged = this.configured = this.enabled = this.busy = this.asleep = false;
    this.usb.onUSBEnabled = () => {};
    this.written = new Map(); // of a buffer's control: what and when
    this.usb.onResetReceived = () => {};
    this.usb.DPRAMUpdated = (offset, value) => {
      const phase = chip.now - this.frameNs;
      if (offset === 0x90) {
        // buffer 0 is the next one from when it is handed over with RESET
        const resets = (value & (RESET | AVAILABLE)) === (RESET | AVAILABLE);
        if (resets && !this.resets) this.buffer[IN] = 0;
        this.resets = resets;
        const available = value & ((AVAILABLE << 16) | AVAILABLE);
        if (available & ~this.available && phase > LATE_NS[0] && phase < LATE_NS[1]) this.latePackets++;
        this.available = available;
      }
      if (offset >= 0x80 && offset < 0x100) {
        this.#checkHandedOver(offset, value);
        this.#serve();
      }
    };
    this.frameNs = 0; // when the present frame began
    this.latePackets = this.available = 0;
    this.buffer = [1, 0];
    const read = this.usb.readUint32.bind(this.usb);
    this.usb.readUint32 = (offset) => {
      if (offset === SOF_RD) this.#signalFrame(false);
      return read(offset);
    };
    this.frame = chip.clock.createAlarm(() => {
      if (!this.plugged || this.asleep) return;
      this.frameNs = chip.now;
      this.usb.sofFrameNumber++;
      this.#signalFrame(true);
      this.frame.schedule(FRAME_NS);
      this.#serve();
    });
    // The emulator does not clear what the chip does.
    const write = this.usb.writeUint32.bind(this.usb);
    const registers = {};
    const has = (offset, bits) => (registers[offset] & bits) === bits;
    this.usb.writeUint32 = (offset, value) => {
      if (offset === SIE_STATUS) this.usb.sieStatus &= ~(this.usb.rawWriteValue & SIE_SUSPENDED);
      write(offset, value);
      registers[offset] = value;
      const there = has(MUXING, TO_PHY) && has(PWR, VBUS_DETECTED) && has(SIE_CTRL, PULL_UP);
      if (there && !this.enabled && this.plugged) this.#begin();
      this.enabled = there;
    };
    this.idle = chip.clock.createAlarm(() => {
      this.usb.sieStatus |= SIE_SUSPENDED;
      this.usb.sieStatusUpdated();
    });
    this.rested = chip.clock.createAlarm(() => this.#serve());
    this.step = chip.clock.createAlarm(() => this.#advance());
    this.done = chip.clock.createAlarm(() => {
      this.busy = false;
      this.finish();
      this.#serve();
    });
  }

  plug(plugged, reading) {
    this.reading = reading;
    if (plugged && !this.plugged && this.enabled) this.#begin();
    if (!plugged) {
      this.configured = false;
      this.idle.schedule(IDLE_NS);
    }
    this.plugged = plugged;
    this.#serve();
  }

  send(bytes) {
    this.toSend.push(...bytes);
    this.#serve();
  }

  // Sets the line coding, as a host does when a program sets the port's speed.
  setBaud(baud) {
    this.script = this.#write(setup(0x21, 0x20, 0, 0, 7), [
      ...le16(baud & 0xffff),
      ...le16(baud >>> 16),
      ...[0, 0, 8],
    ]);
    this.#advance();
  }

  // Raises or lowers DTR, as a host does when a program opens or closes the port.
  setDtr(raised) {
    this.script = this.#write(setup(0x21, 0x22, raised ? 3 : 0, 0, 0));
    this.#advance();
  }

  // Makes no more frames, as a host that sleeps, or makes them again.
  suspend(asleep) {
    this.asleep = asleep;
    if (asleep) this.idle.schedule(IDLE_NS);
    else this.frame.schedule(RESUME_NS);
  }

  // Clears the halt of a bulk endpoint, as some hosts do when a program opens the port.
  clearHalt(direction) {
    this.script = this.#clearHalt(direction);
    this.#advance();
  }

  *#clearHalt(direction) {
    yield* this.#write(setup(0x02, 1, 0, direction === IN ? 0x82 : 0x02, 0));
    this.toggle[direction] = 0;
  }

  // Makes any request, of 8 bytes; then answer gets the bytes of the device, or null if it stalls. given_up: the
  // host sends nothing after the request, and the answer is of no bytes.
  request(packet, givenUp, answer) {
    this.script = this.#request([...packet], givenUp, answer);
    this.#advance();
  }

  *#request(packet, givenUp, answer) {
    if (givenUp) {
      yield { setup: packet };
      answer([]);
    } else if (packet[0] & 0x80) {
      answer(yield* this.#read(packet));
    } else {
      yield { setup: packet };
      answer(yield { direction: IN, toggle: DATA1 });
      if (packet[0] === 0 && packet[1] === 9) this.toggle = [0, 0];
    }
  }

  #signalFrame(begins) {
    if (begins) this.usb.intRaw |= DEV_SOF;
    else this.usb.intRaw &= ~DEV_SOF;
    this.usb.checkInterrupts();
  }

  #begin() {
    this.configured = false;
    this.buffer = [1, 0]; // the next one; of IN unknown until it is reset
    this.frame.schedule(FRAME_NS);
    this.address = 0;
    this.script = this.#enumerate();
    this.#advance();
  }

  // Continues the enumeration, which yields the ns to wait or a transaction of endpoint 0.
  #advance(result) {
    const { value, done } = this.script.next(result);
    this.wanted = null;
    if (done) return;
    if (typeof value === 'number') this.step.schedule(value);
    else {
      this.wanted = value;
      this.#serve();
    }
  }

  *#enumerate() {
    const descriptor = (type, index, length) =>
      this.#read(setup(0x80, 6, (type << 8) | index, type === 3 ? 0x0409 : 0, length));
    this.address = 0;
    yield* this.#reset();
    yield* descriptor(1, 0, 64);
    yield* this.#reset();
    yield* this.#write(setup(0x00, 5, 17, 0, 0));
    this.address = 17;
    yield 2e6;
    const device = yield* descriptor(1, 0, 18);
    const qualifier = yield* descriptor(6, 0, 10);
    const head = yield* descriptor(2, 0, 9);
    const configuration = yield* descriptor(2, 0, head[2] | (head[3] << 8));
    const strings = [];
    for (let index = 0; index < 5; index++) strings.push(yield* descriptor(3, index, 255));
    yield* this.#write(setup(0x00, 9, configuration[5], 0, 0));
    this.toggle = [0, 0];
    this.transfer = [];
    const coding = yield* this.#read(setup(0xa1, 0x21, 0, 0, 7));
    yield* this.#write(setup(0x21, 0x20, 0, 0, 7), coding);
    yield* this.#write(setup(0x21, 0x22, 3, 0, 0));
    this.configured = true;
    this.enumerated({ device, qualifier, configuration, strings });
  }

  *#reset() {
    this.usb.sieStatus |= SIE_BUS_RESET;
    this.usb.sieStatusUpdated();
    yield 10e6;
  }

  // A control transfer with data from the device: its bytes, or null if the device stalls.
  *#read(packet) {
    const asked = packet[6] | (packet[7] << 8);
    const bytes = [];
    let toggle = DATA1;
    yield { setup: packet };
    for (;;) {
      const part = yield { direction: IN, toggle };
      if (part === null) return null;
      bytes.push(...part);
      toggle ^= DATA1;
      if (part.length < PACKET || bytes.length >= asked) break;
    }
    yield { direction: OUT, toggle: DATA1, bytes: [] };
    if (bytes.length > asked) throw new Error(`${bytes.length} bytes, ${asked} were asked for`);
    return bytes;
  }

  // A control transfer with data to the device, or none.
  *#write(packet, bytes = []) {
    yield { setup: packet };
    let result = 0;
    if (bytes.length) result = yield { direction: OUT, toggle: DATA1, bytes };
    if (result !== null) result = yield { direction: IN, toggle: DATA1 };
    if (result === null) throw new Error(`request ${packet} was refused`);
  }

  // Puts the next transaction on the bus, if the device is ready for one.
  #serve() {
    if (this.busy || !this.plugged || this.asleep) return;
    if (this.wanted) this.#serveControl(this.wanted);
    else if (this.configured) this.#serveBulk();
  }

  #serveControl(wanted) {
    if (wanted.setup) {
      this.#start(8, () => {
        this.usb.epStallArm = 0; // the only effect of a SETUP on the buffers of endpoint 0
        this.usb.sendSetupPacket(Uint8Array.from(wanted.setup));
        this.wanted = null;
        this.step.schedule(TOKEN_NS);
      });
      return;
    }
    const control = this.#control(0, wanted.direction);
    if (control & STALL && this.usb.epStallArm & (1 << wanted.direction)) {
      this.#start(0, () => this.#advance(null));
    } else if (control & AVAILABLE) {
      this.#check(control & DATA1, wanted.toggle, 'data toggle of endpoint 0');
      const bytes = wanted.bytes ?? this.#bytes(0x100, control & LENGTH);
      this.#start(bytes.length, () => {
        this.#complete(0, wanted.direction, bytes, 0x100);
        this.#advance(bytes);
      });
    }
  }

  #serveBulk() {
    const phase = this.chip.now - this.frameNs;
    if (phase + TRANSACTION_NS(PACKET) > FRAME_NS) return;
    if (this.bus && phase < this.bus.busy * FRAME_NS) {
      this.rested.schedule(this.bus.busy * FRAME_NS - phase);
      return;
    }
    for (const direction of this.toSend.length ? [OUT, IN] : [IN]) {
      const number = this.buffer[direction];
      const control = this.#control(2, direction) >>> (16 * number);
      if (direction === IN && (!this.reading || this.chip.now < this.restsUntil)) continue;
      if (this.bus && direction === IN) this.asks++;
      if (!(control & AVAILABLE)) {
        if (!this.bus || direction === OUT) continue;
        this.naks++;
        this.busy = true;
        this.finish = () => this.#rest(this.bus.retry_ns);
        this.done.schedule(NAK_NS);
        return;
      }
      this.#check(control & DATA1, this.toggle[direction], `data toggle of ${direction}`);
      this.toggle[direction] ^= DATA1;
      const base = this.view.getUint32(direction === IN ? 0x10 : 0x14, true);
      const buffer = (base & 0xffc0) + PACKET * number;
      if (base & DOUBLE_BUFFERED) this.buffer[direction] ^= 1;
      const bytes =
        direction === IN
          ? this.#bytes(buffer, control & LENGTH)
          : this.toSend.splice(0, Math.min(PACKET, control & LENGTH));
      this.#start(bytes.length, () => {
        this.#complete(2, direction, bytes, buffer, number);
        if (direction === IN) this.#collect(bytes);
        if (this.bus && direction === IN) this.#rest(this.bus.gap_ns);
      });
      return;
    }
  }

  #rest(ns) {
    this.restsUntil = this.chip.now + ns;
    if (ns) this.rested.schedule(ns);
  }

  #collect(bytes) {
    this.transfer.push(...bytes);
    if (bytes.length === PACKET && this.transfer.length < TRANSFER) return;
    if (this.transfer.length) this.received(this.transfer);
    this.transfer = [];
  }

  #start(size, finish) {
    // a new address counts from 2 ms after its request is over (9.2.6.3), the old one until then
    this.#check(this.usb.addrEndp & 0x7f, this.address, 'device address');
    this.busy = true;
    this.finish = finish;
    this.done.schedule(TRANSACTION_NS(size));
  }

  // Does what the controller does when a buffer has been sent or filled.
  #complete(endpoint, direction, bytes, buffer, number = 0) {
    const shift = 16 * number;
    let control = this.#control(endpoint, direction) & ~(AVAILABLE << shift);
    if (direction === OUT) {
      this.chip.rp2040.usbDPRAM.set(bytes, buffer);
      control = (control & ~LENGTH) | bytes.length | FULL;
    } else {
      control &= ~(FULL << shift);
      this.available &= ~(AVAILABLE << shift);
    }
    this.#control(endpoint, direction, control);
    this.usb.indicateBufferReady(endpoint, direction === OUT);
  }

  // AVAILABLE may only be set once the rest of a buffer's control has been there for a while.
  #checkHandedOver(offset, value) {
    const before = this.written.get(offset) ?? { value: 0, at: 0 };
    for (const shift of [0, 16]) {
      const [was, is] = [before.value >>> shift, value >>> shift].map((bits) => bits & 0xffff);
      if (!(is & AVAILABLE) || was & AVAILABLE) continue;
      this.#check(is & ~AVAILABLE, was, `before AVAILABLE, the control of the buffer at ${offset.toString(16)}`);
      if (this.chip.now - before.at < SETTLE_NS)
        throw new Error(`AVAILABLE comes ${this.chip.now - before.at} ns after the rest, should be ${SETTLE_NS}`);
    }
    this.written.set(offset, { value, at: this.chip.now });
  }

  #control(endpoint, direction, value) {
    const offset = 0x80 + 8 * endpoint + 4 * direction;
    if (value !== undefined) {
      this.view.setUint32(offset, value, true);
      this.written.set(offset, { value, at: 0 });
    }
    return this.view.getUint32(offset, true);
  }

  #bytes(offset, size) {
    return [...this.chip.rp2040.usbDPRAM.slice(offset, offset + size)];
  }

  #check(found, expected, what) {
    if (found !== expected) throw new Error(`${what} is ${found}, should be ${expected}`);
  }
}
