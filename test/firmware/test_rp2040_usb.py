# SPDX-License-Identifier: Apache-2.0

"""The RP2040's image on a USB bus: what USB 2.0, its class for serial ports and its hubs demand.

The emulated host (rp2040_usb_host.mjs) checks address, toggles and buffers of every transaction.
"""

from pathlib import Path

import pytest

from rp2040 import Rp2040
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.wire.messages import Ack, FrameLayout, GetInfo
from test.support.rp2040_bench import READY_S, Bench, sine

FEEDS = 22
"""GPIO that a board ties to ground if it feeds strips."""
DEVICE = bytes.fromhex(
    "12 01 0002"  # USB 2.0, table 9-8: length, type, version 2.00
    "ef 02 01"  # of a device with interface associations (ECN of 2003)
    "40"  # packets of endpoint 0, bytes
    "0912 0100 0001"  # 1209:0001 of pid.codes, release 1.00
    "01 02 03 01"  # strings; configurations
)
CONFIGURATION = (
    "09 02 4b00 02 01 00 80 {power:02x}"  # table 9-10: 75 bytes, 2 interfaces, fed by the bus
    "08 0b 00 02 02 02 00 00"  # association: interfaces 0 and 1 are a function, CDC ACM
    "09 04 00 00 01 02 02 00 00"  # table 9-12: interface 0, one endpoint
    "05 24 00 1001"  # PSTN 1.2 and CDC 1.1, 5.2.3: release 1.10
    "05 24 01 00 01"  # no call management; data on interface 1
    "04 24 02 02"  # line coding and state
    "05 24 06 00 01"  # union: interface 0 controls, 1 is subordinate
    "07 05 81 03 0800 ff"  # table 9-13: IN 1, interrupt, 8 bytes, every 255 ms
    "09 04 01 00 02 0a 00 00 00"  # interface 1: data
    "07 05 02 02 4000 00"  # OUT 2, bulk, 64 bytes: the most at full speed (5.8.3)
    "07 05 82 02 4000 00"
)
GET_STATUS, CLEAR_FEATURE, GET_DESCRIPTOR, GET_CONFIGURATION, SET_CONFIGURATION = 0, 1, 6, 8, 9
GET_LINE_CODING = 0x21
IN_DEVICE, IN_INTERFACE, IN_ENDPOINT, IN_CLASS, IN_VENDOR = 0x80, 0x81, 0x82, 0xA1, 0xC0


@pytest.mark.parametrize(
    ("image", "grounded", "current_ma"),
    [("digitizer.bin", (), 100), ("digitizer.bin", (FEEDS,), 500), ("demo.bin", (), 100)],
)
def test_descriptors_are_those_of_the_documents(
    rp2040_image: Path, image: str, grounded: tuple[int, ...], current_ma: int
) -> None:
    """A hub without a supply of its own gives 100 mA and refuses who asks for more."""
    with Rp2040(rp2040_image.with_name(image), sine, grounded=grounded) as board:
        board.plug_usb()
        board.run(READY_S)
        told = board.usb_device
        assert told is not None
        assert told.device == DEVICE
        assert told.configuration == bytes.fromhex(CONFIGURATION.format(power=current_ma // 2))


def test_requests_of_chapter_9(bench: Bench) -> None:
    whole = bytes.fromhex(CONFIGURATION.format(power=50))
    ask = bench.board.usb_request
    for length in (8, 9, 18, 63, 64, 65, 75, 255):  # 9.3.5: as many as asked for, if there are
        assert ask(IN_DEVICE, GET_DESCRIPTOR, 0x0200, 0, length) == whole[:length]
        assert ask(IN_DEVICE, GET_DESCRIPTOR, 0x0100, 0, length) == DEVICE[:length]
    assert ask(IN_DEVICE, GET_DESCRIPTOR, 0x0300, 0, 255) == bytes.fromhex("04 03 0904")
    assert ask(IN_DEVICE, GET_STATUS, 0, 0, 2) == bytes(2), "fed by the bus, wakes nobody"
    assert ask(IN_INTERFACE, GET_STATUS, 0, 0, 2) == bytes(2)
    assert ask(IN_ENDPOINT, GET_STATUS, 0, 0x82, 2) == bytes(2), "not halted"
    coding = ask(IN_CLASS, GET_LINE_CODING, 0, 0, 7)
    assert coding == (115_200).to_bytes(4, "little") + bytes([0, 0, 8])
    for kind, request in ((0x00, 7), (IN_VENDOR, 1), (IN_CLASS, 0x77), (0x02, 0x55)):
        assert ask(kind, request, 0, 0, 8 if kind & 0x80 else 0) is None, "9.2.7: stalls"
        assert ask(IN_DEVICE, GET_CONFIGURATION, 0, 0, 1) == b"\1", "and the next is obeyed"
    assert ask(0x00, SET_CONFIGURATION, 0) == b""
    assert ask(IN_DEVICE, GET_CONFIGURATION, 0, 0, 1) == b"\0"
    assert ask(0x00, SET_CONFIGURATION, 1) == b""
    assert ask(IN_DEVICE, GET_CONFIGURATION, 0, 0, 1) == b"\1"
    assert not bench.of(Ack)
    bench.send(GetInfo())
    bench.run(0.01)
    assert bench.of(Ack), "its endpoints begin anew with DATA0"


def test_a_request_that_is_given_up_spoils_no_other(bench: Bench) -> None:
    """9.3: a new request ends the last one, whatever it has left in the buffers."""
    ask = bench.board.usb_request
    for kind, request, value, length in (
        (IN_DEVICE, GET_DESCRIPTOR, 0x0200, 75),
        (0x21, 0x20, 0, 7),
        (0x00, 7, 0, 0),
    ):
        ask(kind, request, value, 0, length, given_up=True)
        assert ask(IN_DEVICE, GET_DESCRIPTOR, 0x0100, 0, 18) == DEVICE


def test_a_cleared_halt_begins_with_data0(bench: Bench) -> None:
    """9.4.5: both ways, after any number of packets, whether some wait or none."""
    for asked in range(1, 6):
        bench.send(GetInfo())
        bench.run(0.003)
        bench.board.clear_usb_halt(out=asked % 3 > 0)
        bench.run(0.003)
        assert len(bench.of(Ack)) == asked
    bench.stream(FrameLayout.of(FrameSpec(), 4), 0.02)
    for moment in range(1, 5):
        bench.board.plug_usb(reading=False)
        bench.run(0.002)
        bench.board.clear_usb_halt()
        bench.run(0.002)
        bench.board.plug_usb()
        bench.run(0.0101 * moment)
    assert bench.check(bench.line) > 80_000 * 0.1
    assert bench.parser.counters.lost_packets == 0
