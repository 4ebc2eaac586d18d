# SPDX-License-Identifier: Apache-2.0

"""Ports: every byte in order, clear errors, found by USB serial number, listed with digitizers."""

import gc
import json
import os
import socket
import stat
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from io import FileIO
from pathlib import Path

import numpy as np
import pytest
from serial.tools import list_ports

from tactile_cdma.base.errors import PortError
from tactile_cdma.wire.discovery import find_usb, held_back, holders, is_away, serial_ports
from tactile_cdma.wire.introduction import introduction
from tactile_cdma.wire.messages import GetInfo, Start, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from tactile_cdma.wire.port import HOST_GONE_S, Port
from tactile_cdma.wire.reader import NO_FILE, READ_SIZE
from test.support.boards import board, board_id, chattering, plugged, usb_port
from test.support.command_line import Printed
from test.support.waiting import wait_for


@contextmanager
def pty_port() -> Iterator[tuple[FileIO, Port]]:
    host, device = os.openpty()
    tty.setraw(device)
    name = os.ttyname(device)
    with os.fdopen(host, "wb", buffering=0) as file, Port(name, 115_200) as port:
        os.close(device)
        yield file, port


@contextmanager
def socket_port(scheme: str = "socket") -> Iterator[tuple[socket.socket, Port]]:
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        Port(f"{scheme}://127.0.0.1:{server.getsockname()[1]}", 115_200) as port,
    ):
        connection, _ = server.accept()
        with connection:
            yield connection, port


def read_all(port: Port, size: int) -> list[bytes]:
    parts: list[bytes] = []
    while sum(map(len, parts)) < size:  # each waits for a byte
        parts.append(port.read()[0])
    return parts


SENT = np.random.default_rng(1).integers(0, 256, 9000, dtype=np.uint8).tobytes()


@pytest.mark.parametrize("has_files", [True, False])
def test_all_bytes_are_counted_read_in_order_or_skipped(
    has_files: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without files as on Windows, where the kernel has no descriptor to read."""
    monkeypatch.setattr("tactile_cdma.wire.port.HAS_FILES", has_files)
    with pty_port() as (host, port):
        assert (port.file == NO_FILE) == (not has_files)
        assert port.waiting == port.skip() == 0
        for size in (1, 4095, 4096, 9000):
            host.write(SENT[:size])
            assert b"".join(read_all(port, size)) == SENT[:size]
        assert port.read()[0] == b""
        host.write(SENT[:1000])
        wait_for(lambda: port.waiting == 1000)  # the kernel delivers them later
        assert port.skip() == 1000 and port.waiting == 0
        host.write(b"later")
        assert b"".join(read_all(port, 5)) == b"later"
        port.close()
        for use in (lambda: port.waiting, port.skip):
            with pytest.raises(PortError, match="unplugged"):
                use()
    with socket_port() as (connection, port):
        connection.sendall(SENT)
        assert b"".join(read_all(port, 9000)) == SENT


def test_one_read_takes_a_whole_packet_however_it_comes() -> None:
    """A tty gives 4 kB at once; and a packet that does not end holds nothing up for long."""
    packet = bytes(SENT).replace(b"\0", b"\1") + b"\0"
    with pty_port() as (host, port):

        def send() -> None:
            for begin in range(0, len(packet), 1000):
                host.write(packet[begin : begin + 1000])
                time.sleep(2e-3)

        def is_whole() -> bool:
            sender = threading.Thread(target=send)
            sender.start()
            data = port.read()[0]
            is_whole = data == packet and not port.had_waited
            sender.join()
            read_all(port, len(packet) - len(data))
            return is_whole

        # on a busy machine the sender itself may pause for too long
        assert any(is_whole() for _ in range(20))
        host.write(packet[:-1])
        assert b"".join(read_all(port, len(packet) - 1)) == packet[:-1]
        host.write(b"\0" + packet[:100])
        time.sleep(0.05)
        assert port.read()[0][:1] == b"\0"
        assert port.had_waited


def test_a_socket_gives_all_bytes_in_order_and_no_read_is_endless() -> None:
    with socket_port() as (connection, port):
        flood = SENT * 40
        connection.settimeout(5)
        sent = connection.send(flood)
        parts = read_all(port, sent)
        assert b"".join(parts) == flood[:sent]
        assert max(map(len, parts)) <= READ_SIZE
        assert port.read()[0] == b""


def test_a_port_whose_other_end_is_gone_is_lost() -> None:
    with pty_port() as (host, port):
        host.close()
        with pytest.raises(PortError, match="lost while reading; unplugged"):
            port.read()
    with socket_port() as (connection, port):
        connection.sendall(b"last words")
        connection.close()
        assert port.read()[0] == b"last words"
        with pytest.raises(PortError, match="end of file"):
            port.read()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("", "no port is named; Serial ports on this machine"),
        ("/tmp", "not a serial port"),
        ("/dev/null", "not a serial port"),
        ("socket://", "host and port .* are not named"),
        ("socket://localhost", "host and port .* are not named"),
        ("socket://localhost:99999", "host and port .* are not named"),
        ("RFC2217://localhost:4000", r"without a bound; .*plain bytes, and use socket://host:port"),
        ("socket://localhost:1", "refused"),
        ("/dev/ttyNOSUCH", "no such port; is the digitizer plugged in"),
        ("com://1", "unknown kind of port"),
        ("sim://?scene=nonsense", "scene"),
        ("hwgrep://(", r"hwgrep://\("),  # options of pyserial's own handlers
        ("alt:///dev/null?class=os", r"alt:///dev/null\?class=os"),
    ],
)
def test_a_port_that_cannot_be_opened_is_an_error_with_its_cause(url: str, message: str) -> None:
    with pytest.raises(PortError, match=message):
        Port(url, 115_200)


def test_a_port_opens_in_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder := tmp_path / "gone").mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    with Port("sim://?scene=all", 1_000_000) as port:
        wait_for(lambda: port.read()[0])


def test_a_tty_that_this_program_has_open_is_busy_by_itself() -> None:
    with pty_port() as (_, port):
        with pytest.raises(PortError, match="busy: this program has it open already"):
            Port(port.url, 115_200)
        port.close()
        Port(port.url, 115_200).close()


def test_a_name_that_outlasts_its_device_is_unplugged(tmp_path: Path) -> None:
    """As a node of /dev that nobody has removed; here of a terminal whose master is closed."""
    master, slave = os.openpty()
    os.close(master)
    link = tmp_path / "ttyACM0"
    link.symlink_to(f"/proc/self/fd/{slave}")
    with pytest.raises(PortError, match="no device is behind it, unplugged"):
        Port(str(link), 115_200)
    os.close(slave)


@pytest.mark.skipif(getattr(os, "geteuid", int)() != 0, reason="only root can make device nodes")
def test_a_device_node_without_a_driver_is_unplugged(tmp_path: Path) -> None:
    node = tmp_path / "ttyUSB77"
    os.mknod(node, stat.S_IFCHR | 0o600, os.makedev(188, 77))
    with pytest.raises(PortError, match="no device is behind it, unplugged"):
        Port(str(node), 115_200)


@contextmanager
def forked() -> Iterator[None]:
    """Beside a child that collects what it has, and then lives on until the context ends."""
    (told, tell), (ready, done) = os.pipe(), os.pipe()
    if (child := os.fork()) == 0:
        try:
            os.close(tell)
            gc.collect()
            os.write(done, b".")
            os.read(told, 1)
        finally:
            os._exit(0)
    try:
        assert os.read(ready, 1)
        yield
    finally:
        for end in (told, tell, ready, done):
            os.close(end)
        os.waitpid(child, 0)


def test_a_fork_keeps_nothing_open_and_ends_no_connection() -> None:
    with pty_port() as (host, port), forked():
        host.write(b"goes on")
        assert b"".join(read_all(port, 7)) == b"goes on"
        port.close()
        Port(port.url, 115_200).close()
    with socket_port() as (connection, port):
        if (child := os.fork()) == 0:
            port.close()
            os._exit(0)
        os.waitpid(child, 0)
        connection.sendall(b"goes on")
        assert b"".join(read_all(port, 7)) == b"goes on"


def test_time_is_taken_after_the_bytes_came() -> None:
    with pty_port() as (host, port):
        times = []
        for _ in range(3):
            host.write(b"x")
            times.append(port.read()[1])
        assert times == sorted(times)
        assert len(set(times)) == 3


def test_a_device_is_away_while_it_cannot_be_opened(tmp_path: Path) -> None:
    device, link = tmp_path / "device", tmp_path / "link"
    link.symlink_to(device)
    assert is_away(str(link))
    device.touch()
    assert not is_away(str(link))
    for url in ("usb://1234", "socket://127.0.0.1:1", "sim://", "no\0path"):
        assert not is_away(url)


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="Linux tells TCP how long")
def test_a_host_that_acknowledges_nothing_is_given_up() -> None:
    """The kernel then fails the read; by default it would retry for a quarter of an hour."""
    with socket_port() as (_, port):
        own = socket.fromfd(port.device.fileno(), socket.AF_INET, socket.SOCK_STREAM)
        with own:
            given_up_ms = own.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)
    assert given_up_ms == HOST_GONE_S * 1e3


def test_a_socket_in_capitals_is_a_socket() -> None:
    with socket_port("SOCKET") as (_, port):
        assert port.over_network and port.file != NO_FILE
    with pytest.raises(PortError, match="are not named"):
        Port("Socket://localhost", 0)


def test_bytes_waiting_in_a_virtual_port_are_skipped_too() -> None:
    with Port("sim://?speed=0", 0) as port:
        port.write(PacketWriter().encode(Start()))
        wait_for(lambda: port.waiting >= 1000)
        assert port.skip() >= 1000


@pytest.mark.parametrize("kind", ["spy", "SPY"])
def test_a_url_cannot_make_a_port_write_a_file(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "mine"
    path.write_text("kept")
    with pytest.raises(PortError, match="would write a file"):
        Port(f"{kind}://loop://?file={path}", 9600)
    assert path.read_text() == "kept"


def test_a_search_by_pyserial_opens_what_it_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    host, device = os.openpty()
    tty.setraw(device)
    found = usb_port(os.ttyname(device), "E6605838")
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda *_: [found])
    with os.fdopen(host, "wb", buffering=0) as file, Port("hwgrep://e6605", 9600) as port:
        os.close(device)
        file.write(SENT[:3000])
        assert b"".join(read_all(port, 3000)) == SENT[:3000]


def test_a_port_without_a_file_gives_all_that_waits_at_once() -> None:
    with Port("loop://", 9600) as port:
        port.write(b"all of it")
        assert port.read()[0] == b"all of it"


@pytest.mark.parametrize(("held_ms", "told"), [("16", True), ("1", False), (None, False)])
def test_adapters_holding_back_are_told(tmp_path: Path, held_ms: str | None, told: bool) -> None:
    timer = tmp_path / "ttyUSB0" / "latency_timer"
    timer.parent.mkdir()
    if held_ms:
        timer.write_text(f"{held_ms}\n")
    said = held_back("/dev/ttyUSB0", tmp_path)
    assert said.endswith(f"could not be changed: echo 1 | sudo tee {timer}" if told else "")
    assert ("up to 16 ms" in said) == told


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


def test_boards_are_found_by_number_anywhere(kernel: Kernel, boards: dict[int, str]) -> None:
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


def test_who_is_where_is_told(kernel: Kernel, boards: dict[int, str], printed: Printed) -> None:
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


def test_programs_that_end_are_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
