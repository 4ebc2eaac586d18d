# SPDX-License-Identifier: Apache-2.0

"""Ports by USB serial number, and the command that lists ports with their digitizers.

Boards are virtual digitizers on real ttys; only the list of USB devices is faked.
"""

import json
import os
import subprocess
import sys
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
from serial.tools import list_ports

from tactile_cdma.base.errors import PortError
from tactile_cdma.wire.discovery import find_usb, holders, serial_ports
from tactile_cdma.wire.introduction import introduction
from tactile_cdma.wire.messages import GetInfo, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from tactile_cdma.wire.port import Port
from test.support.boards import board, board_id, chattering, plugged, usb_port
from test.support.command_line import Printed

Kernel = list[tuple[str, str | None]]


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Kernel:
    """USB ports of this machine: device, serial number; tests plug them in and out."""
    ports: Kernel = []
    monkeypatch.setattr(list_ports, "comports", lambda: [usb_port(*port) for port in ports])
    return ports


@pytest.fixture(scope="module")
def boards() -> Iterator[dict[int, str]]:
    """Ports of boards 1 and 2, which send INFO twenty times a second."""
    with plugged(board(1, "speed=20")) as first, plugged(board(2, "speed=20")) as second:
        yield {1: first, 2: second}


def test_a_board_is_found_by_its_number_wherever_it_is(
    kernel: Kernel, boards: dict[int, str]
) -> None:
    for places in ((1, 2), (2, 1)):  # numbers swap their devices
        kernel[:] = [(boards[seed], f"Ab{seed}") for seed in places]
        for seed, device in boards.items():
            for url in (f"usb://Ab{seed}", f"usb://aB{seed}"):
                with Port(url, 115_200) as port:
                    assert introduction(port).digitizer_id.hex().upper() == board_id(seed)
                    with pytest.raises(PortError, match="busy"):
                        Port(device, 115_200)


def test_a_renumbered_board_is_found_again(kernel: Kernel, boards: dict[int, str]) -> None:
    kernel[:] = [(boards[1], "X")]
    Port("usb://X", 115_200).close()
    kernel.clear()
    with pytest.raises(PortError, match="no port has this USB serial number"):
        Port("usb://X", 115_200)
    kernel[:] = [(boards[2], "X")]
    with Port("usb://X", 115_200) as port:
        assert introduction(port).digitizer_id.hex().upper() == board_id(2)


def test_none_and_several_are_refused_with_what_is_there(kernel: Kernel) -> None:
    kernel[:] = [("/dev/ttyACM0", "A1"), ("/dev/ttyUSB0", None), ("/dev/ttyACM1", "A10")]
    ports = serial_ports()
    assert find_usb("usb://A1", ports) == "/dev/ttyACM0"  # not A10, of which it is a prefix
    with pytest.raises(PortError) as none:
        find_usb("usb://A", ports)
    for device, number in kernel:
        assert device in str(none.value)
        assert number is None or number in str(none.value)
    kernel.append(("/dev/ttyACM2", "A1"))
    with pytest.raises(PortError, match=r"2 ports have.*by-path") as several:
        find_usb("usb://A1", serial_ports())
    assert "/dev/ttyACM0" in str(several.value)
    assert "/dev/ttyACM2" in str(several.value)
    assert "/dev/ttyACM1" not in str(several.value)
    with pytest.raises(PortError, match="serial number of a USB device is missing"):
        find_usb("usb://", ports)


def test_the_command_tells_who_is_where(
    kernel: Kernel, boards: dict[int, str], printed: Printed
) -> None:
    kernel[:] = [(boards[1], "AB"), (boards[2], None), ("/dev/ttyNOSUCH", None)]
    with chattering(b"G28 X0 Y0 ok\r\n") as printer:
        kernel.append((printer, "3D"))
        found = {port["device"]: port for port in json.loads(printed("ports", "--json").out)}
        for seed in (1, 2):
            assert found[boards[seed]]["digitizer_id"] == board_id(seed)
            assert found[boards[seed]]["frame"]["nodes"] == 16
        assert "text received" in found[printer]["reason"]
        assert "no such port" in found["/dev/ttyNOSUCH"]["reason"]
        text = printed("ports", boards[2], "usb://AB").out
        assert board_id(2) in text
        assert board_id(1) in text
        text = printed("ports", "--list").out
        assert "usb://AB" in text
        assert board_id(1) not in text


def test_a_busy_port_is_left_alone(boards: dict[int, str], printed: Printed) -> None:
    with Port(boards[1], 115_200):
        first, second = printed("ports", boards[1], boards[2]).out.split(boards[2])
    assert "busy" in first
    assert board_id(2) in second


def test_nothing_is_sent_to_what_does_not_speak_our_protocol() -> None:
    host, device = os.openpty()
    tty.setraw(device)
    os.set_blocking(host, False)
    with (
        os.fdopen(host, "r+b", buffering=0) as other_end,
        Port(os.ttyname(device), 115_200) as port,
    ):
        other_end.write(b"ok T:21.3 /0.0 B:20.9 /0.0\r\n")
        with pytest.raises(PortError, match="text received"):
            introduction(port, 0.3)
        assert other_end.read() is None
        # An intact packet of ours makes a question harmless.
        other_end.write(b"\0" + PacketWriter().encode(Status(uptime_us=1)))
        with pytest.raises(PortError, match="no description"):
            introduction(port, 0.3)
        assert PacketParser().feed(other_end.read() or b"") == [GetInfo()]
    os.close(device)


def test_programs_that_hold_a_file_are_named(tmp_path: Path) -> None:
    path = tmp_path / "ttyACM0"
    path.touch()
    assert holders(str(path)) == []
    program = "import sys; file = open(sys.argv[1]); print(flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", program, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        assert [f"(pid {other.pid})" in holder for holder in holders(str(path))] == [True]
        assert other.stdin is not None
        other.stdin.close()


@pytest.mark.parametrize("without", ["/nothing", "/sys"])
def test_what_is_no_serial_port_is_not_busy(
    without: str, tmp_path: Path, printed: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though somebody has it open: this program. Containers may have no /sys."""
    exists = os.path.exists
    monkeypatch.setattr(os.path, "exists", lambda at: not at.startswith(without) and exists(at))
    (tmp_path / "file").touch()
    os.mkfifo(tmp_path / "pipe")
    paths = ["/dev/null", *(str(tmp_path / name) for name in ("file", "pipe", "."))]
    opened = [os.open(path, os.O_RDONLY | os.O_NONBLOCK) for path in paths]
    assert all(map(holders, paths))
    assert printed("ports", *paths).out.count("no digitizer: not a serial port") == len(paths)
    for file in opened:
        os.close(file)


def test_programs_that_end_during_the_look_are_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    listdir = os.listdir

    def vanishing(folder: str) -> list[str]:
        if folder == "/proc":
            return ["1000000000", *listdir(folder)]
        if folder.endswith(f"/{os.getppid()}/fd"):
            raise ProcessLookupError(3, "No such process")
        return listdir(folder)

    monkeypatch.setattr(os, "listdir", vanishing)
    path = tmp_path / "port"
    with path.open("w"):
        assert [f"(pid {os.getpid()})" in holder for holder in holders(str(path))] == [True]


def test_the_udev_rule_knows_the_firmwares_names() -> None:
    root = Path(__file__).resolve().parents[3]
    rule = (root / "config" / "60-tactile-cdma.rules").read_text()
    firmware = root / "firmware" / "digitizer" / "rp2040"
    matches = [line for line in rule.splitlines() if line and not line.startswith(("#", "LABEL"))]
    maker = (firmware / "usb.c").read_text().split('[USB_MANUFACTURER] = "')[1].split('"')[0]
    products = [
        (firmware / source).read_text().split('nodes_product[] = "')[1].split('"')[0]
        for source in ("nodes_elsewhere.c", "demo/nodes_here.c")
    ]
    for line in matches[1:]:
        assert f'{{manufacturer}}=="{maker}"' in line
        assert f'{{product}}=="{"|".join(products)}"' in line
