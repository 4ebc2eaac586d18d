# SPDX-License-Identifier: Apache-2.0

"""`make demo` copies the image to a demonstrator, and never to a digitizer that nobody named."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import serial

from test.support.scripts import ROOT, loaded

IMAGE = b"an image"


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """tools/copy_demo.py on a machine without boards."""
    module = loaded(ROOT / "tools" / "copy_demo.py")
    (tmp_path / "demo.uf2").write_bytes(IMAGE)
    monkeypatch.setattr(sys, "argv", ["", str(tmp_path / "demo.uf2"), ""])
    monkeypatch.setattr(module, "comports", list)
    monkeypatch.setattr(module, "mounted", lambda: None)
    return module


@pytest.mark.parametrize(
    ("port", "products", "restarts"),
    [
        ("", ["Tactile skin demonstrator"], ["tty0"]),
        ("", ["Tactile skin digitizer", "Tactile skin demonstrator"], ["tty1"]),
        ("", ["Tactile skin digitizer", None], []),
        ("", 2 * ["Tactile skin demonstrator"], []),
        ("tty0", ["Tactile skin digitizer"], ["tty0"]),
    ],
)
def test_which_board_is_restarted(
    tool: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    port: str,
    products: list[str | None],
    restarts: list[str],
) -> None:
    opened: list[str] = []
    drive = tmp_path / "drive"
    drive.mkdir()

    def serial_port(name: str, baud: int) -> SimpleNamespace:
        assert baud == 1200
        opened.append(name)
        return SimpleNamespace(close=lambda: None)

    ports = [SimpleNamespace(device=f"tty{i}", product=p) for i, p in enumerate(products)]
    monkeypatch.setattr(tool, "comports", lambda: ports)
    monkeypatch.setattr(serial, "Serial", serial_port)
    monkeypatch.setattr(tool, "mounted", lambda: drive if opened else None)
    monkeypatch.setattr(tool.time, "sleep", lambda seconds: None)
    sys.argv[2] = port
    assert tool.main() == 0
    assert opened == restarts
    copied = {path.name: path.read_bytes() for path in drive.iterdir()}
    assert copied == ({"demo.uf2": IMAGE} if restarts else {})
    assert ("hold its BOOTSEL button" in capsys.readouterr().out) == (not restarts)
