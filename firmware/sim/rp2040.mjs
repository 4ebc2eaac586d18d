// Runs the digitizer's image in an emulated RP2040, controlled by a parent process.
//
//     node rp2040.mjs digitizer.bin flash-id network bus grounded
//
// flash-id: the flash's unique number, 16 hexadecimal digits. network: JSON of resistors by which the chip's
// own pins drive its line: `ohms` of pin 0, 1, …, null for none; `bias_ohms` to the supply and to ground
// each; `noise_counts`, rms; `told`, whether the parent is told of these pins; `pull_ohms` to ground while the
// sync pin is high, or null. Without a network the parent is asked for the line. bus: JSON for
// rp2040_usb_host.mjs. Both may be null. grounded: JSON, pins tied to ground. Messages go over stdin and stdout:
//
//     u8 type, u32 size, payload of this size
//
// little-endian; times are f64 in ns since power-up. The parent sends
//
//     'R' time             run until then; answered by 'D'
//     'U' bytes            to UART0, from now on, at its speed
//     'S' bytes            to USB
//     'H' u8               USB host: 0 unplugged, 1 plugged in but not reading, 2 reading
//     'L' u32              the USB host sets the port's speed, baud
//     'K' u8               the USB host lowers DTR (0) or raises it (1)
//     'Z' u8               the USB host sleeps (1) or is awake again (0)
//     'C' u8               the USB host clears the halt of the device's bulk endpoint, IN (0) or OUT (1)
//     'Q' u8, 8 bytes      the USB host makes this request of its control endpoint; u8: 1 to give up after that
//     'T' f64              stall the CPU for this many ns
//     'M' f64              DMA takes no samples from the ADC for this many ns
//     'E' u8, f64, u8, f64, u8 …  from outside this pin is high (1) or low (0) from these times on; they are to come
//     'A' u16…             counts of the line, for the conversion asked for and those after it
//
// and gets
//
//     'D' time, f64, u8, f64 … it has run until then; cycles awake of the CPU since power-up; 1: it has restarted
//                          as the boot ROM's USB drive, and runs no more; packets offered too late in a USB frame;
//                          how often the host has asked for a packet, and how often there was none: f64, f64
//     'P' time, u8, u8     a pin (16: sync, 25: LED) is now low (0), high (1) or released (2)
//     'U' time, bytes      UART0 has sent them, the last one at that time
//     'S' time, bytes      USB likewise
//     'Q' u8, bytes        the answer; u8: 1 if the device stalled
//     'I' JSON             a USB host has configured the device: its descriptors
//     'A' time, f64, time  a conversion begins; others follow every f64 ns; the sync line does not
//                          change before the second time. Answer with 'A' and at least one count
//     'X' text             an error, which ends the emulator
//
// Messages come in order of time: an answer to 'A' may depend on all edges of the sync line before that
// conversion, and may cover the conversions until the line can next change.

import { readFileSync, readSync, writeSync } from 'node:fs';

const MAX_UART_PIECE = 256;
const PINS = [16, 25];
const RADIO = [23, 24, 29]; // of a Pico W, where other boards have their own

let pending = Buffer.alloc(0);

// The next message of the parent. Exits if the parent has gone.
function receive() {
  const chunk = Buffer.alloc(65536);
  for (;;) {
    if (pending.length >= 5) {
      const end = 5 + pending.readUInt32LE(1);
      if (pending.length >= end) {
        const message = { type: String.fromCharCode(pending[0]), payload: pending.subarray(5, end) };
        pending = pending.subarray(end);
        return message;
      }
    }
    const size = readSync(0, chunk);
    if (!size) process.exit(0);
    pending = Buffer.concat([pending, chunk.subarray(0, size)]);
  }
}

function send(type, ...parts) {
  const payload = Buffer.concat(
    parts.map((part) => (typeof part === 'number' ? float(part) : Buffer.from(part))),
  );
  const head = Buffer.alloc(5);
  head[0] = type.charCodeAt(0);
  head.writeUInt32LE(payload.length, 1);
  const bytes = Buffer.concat([head, payload]);
  for (let sent = 0; sent < bytes.length; ) sent += writeSync(1, bytes, sent);
}

function float(value) {
  const bytes = Buffer.alloc(8);
  bytes.writeDoubleLE(value);
  return bytes;
}

// Counts given in advance by the parent, in reverse order, and the time of the next one's conversion.
let counts = [];
let expected = 0;

function line(now, period) {
  if (!counts.length || Math.abs(now - expected) > period / 16) {
    send('A', now, period, chip.syncStaysUntil);
    const { type, payload } = receive();
    if (type !== 'A' || payload.length < 2) throw new Error(`'A' with counts expected, not '${type}'`);
    counts = [];
    for (let i = payload.length - 2; i >= 0; i -= 2) counts.push(payload.readUInt16LE(i));
  }
  expected = now + period;
  return counts.pop();
}

let uartBytes = [];

function flushUart() {
  if (uartBytes.length) send('U', chip.now, uartBytes);
  uartBytes = [];
}

function uartByte(byte) {
  uartBytes.push(byte);
  if (byte === 0 || uartBytes.length >= MAX_UART_PIECE) flushUart();
}

let chip;
try {
  const { Chip } = await import('./rp2040_chip.mjs');
  const { UsbHost } = await import('./rp2040_usb_host.mjs');
  const [image, flashId, ...rest] = process.argv.slice(2);
  const [network, bus, grounded] = rest.map((json) => JSON.parse(json));
  chip = new Chip({
    image: readFileSync(image),
    flashId: Buffer.from(flashId, 'hex'),
    line: network ?? line,
    uartByte,
    grounded,
  });
  const host = new UsbHost(chip, {
    received: (bytes) => send('S', chip.now, bytes),
    enumerated: (device) => send('I', JSON.stringify(device)),
    bus,
  });
  for (const pin of RADIO)
    chip.onPin(pin, () => {
      throw new Error(`the image drives GPIO${pin}, where a Pico W has its radio`);
    });
  const told = network?.told ? [...network.ohms.keys()] : [];
  for (const pin of [...PINS, ...told]) chip.onPin(pin, (level) => send('P', chip.now, [pin, level]));

  for (;;) {
    const { type, payload } = receive();
    switch (type) {
      case 'R':
        chip.run(payload.readDoubleLE());
        flushUart();
        send('D', chip.now, chip.cycles, [Number(chip.isDrive)], host.latePackets, host.asks, host.naks);
        break;
      case 'U':
        chip.uartReceive(payload);
        break;
      case 'S':
        host.send(payload);
        break;
      case 'H':
        host.plug(payload[0] > 0, payload[0] > 1);
        break;
      case 'L':
        host.setBaud(payload.readUInt32LE());
        break;
      case 'K':
        host.setDtr(payload[0] === 1);
        break;
      case 'Z':
        host.suspend(payload[0] === 1);
        break;
      case 'C':
        host.clearHalt(payload[0]);
        break;
      case 'Q':
        host.request(payload.subarray(1), payload[0] === 1, (bytes) => send('Q', [Number(bytes === null)], bytes ?? []));
        break;
      case 'T':
        chip.stall(payload.readDoubleLE());
        break;
      case 'E':
        for (let i = 1; i < payload.length; i += 9)
          chip.drive(payload[0], payload.readDoubleLE(i), payload[i + 8] === 1);
        break;
      case 'M':
        chip.holdSamples(payload.readDoubleLE());
        break;
      default:
        throw new Error(`message '${type}' is not known`);
    }
  }
} catch (error) {
  send('X', error.code === 'ERR_MODULE_NOT_FOUND' ? error.message : (error.stack ?? String(error)));
  process.exit(1);
}
