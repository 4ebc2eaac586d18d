# SPDX-License-Identifier: Apache-2.0

"""What a program shares with its interrupts, in machine code: touched only while they are off."""

import ctypes
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from test.support.firmware import CORE, FIRMWARE, need, run

RAM = re.compile(r"(ldr|str)b? r\d, \[r\d")
"""Of an ARM's instructions those that touch variables."""


@pytest.fixture(scope="module")
def arm(built: Callable[[str], Path]) -> dict[str, list[str]]:
    """Instructions of every function of the digitizer's image."""
    image = built("rp2040") / "rp2040" / "digitizer.elf"
    return functions(run(need("arm-none-eabi-objdump"), "-d", "--no-show-raw-insn", image))


def avr(source: str, folder: Path) -> dict[str, list[str]]:
    """Instructions of every function of a source of the nodes."""
    options = ("-std=gnu99", "-mmcu=atmega328p", "-Os", "-I", str(CORE), "-c")
    target = folder / "part.o"
    run(need("avr-gcc"), *options, FIRMWARE / "node" / source, "-o", target)
    return functions(run(need("avr-objdump"), "-d", "--no-show-raw-insn", target))


def functions(listing: str) -> dict[str, list[str]]:
    parts = re.split(r"^[0-9a-f]+ <(.+)>:$", listing, flags=re.MULTILINE)
    bodies = {}
    for name, body in zip(parts[1::2], parts[2::2], strict=True):
        lines = [line.split(":", 1)[1] for line in body.splitlines() if ":" in line]
        bodies[name] = [" ".join(re.split("[@;]", line)[0].split()) for line in lines]
    return bodies


@pytest.mark.parametrize("name", ["usb_send", "usb_cancel"])
def test_usb_is_told_with_interrupts_off(arm: dict[str, list[str]], name: str) -> None:
    """A packet that the host takes meanwhile would be counted twice, or never."""
    body = arm[name]
    on = body.index("cpsie i")
    end = next(i for i, text in enumerate(body) if i > on and re.match("bx|pop", text))
    with_interrupts = body[: body.index("cpsid i")] + body[on:end]
    assert len(body) > 10 and not any(map(RAM.match, with_interrupts))


def test_an_interrupt_before_sleep_is_not_missed(arm: dict[str, list[str]]) -> None:
    """Whether there is work is asked with interrupts off, which WFI does not need to wake."""
    body = arm["sleep"]
    kinds = [text.split()[0] for text in body]
    asks = next(i for i, text in enumerate(body) if RAM.match(text))
    assert kinds.index("cpsid") < asks < kinds.index("wfi") < kinds.index("cpsie")


def test_a_ring_sees_what_an_interrupt_puts_into_it(core: ctypes.CDLL) -> None:
    """However the compiler arranges a loop that waits for it."""
    core.ring_is_seen.restype = ctypes.c_bool
    assert core.ring_is_seen()


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("talk.c", "talk_take"),
        ("talk.c", "talk_stop"),
        ("talk.c", "talk_expect"),
        ("atmega328p.c", "board_now"),
    ],
)
def test_nodes_share_frames_with_interrupts_off(source: str, name: str, tmp_path: Path) -> None:
    """Each of them takes several instructions on a machine of 8 bits."""
    listed = "\n".join(avr(source, tmp_path)[name])
    body = re.sub("cli\nout 0x3e.*\nout 0x3f.*\n", "", listed).split("\n")  # of the stack pointer
    touches = [place for place, text in enumerate(body) if re.match("(lds|sts|ld) ", text)]
    off, on = (
        body.index("cli"),
        max(i for i, text in enumerate(body) if text.startswith("out 0x3f")),
    )
    assert touches and off < touches[0]
    assert all(place < on for place in touches if not body[place].startswith("ld "))


def test_a_node_falls_asleep_with_the_instruction_after_sei(tmp_path: Path) -> None:
    """An interrupt between them would be served, and then it would sleep on it."""
    for source in ("atmega328p.c", "avr.c"):
        code = avr(source, tmp_path)
        text = [line.split()[0] for body in code.values() for line in body if line]
        sleeps = [i for i, kind in enumerate(text) if kind == "sleep"]
        assert sleeps and all(text[i - 1] == "sei" for i in sleeps)
