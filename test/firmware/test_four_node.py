# SPDX-License-Identifier: Apache-2.0

"""A node of four sensors: its image, emulated, and a skin of four of them with the driver."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from check import PARAMS, on_virtual_board
from emulated import Node
from skin import IMAGES
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.frame_rate import FOUR, MCUS
from tactile_cdma.config.parameters import DATA, OWN, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.hardware.node_memory import node_memory
from tactile_cdma.hardware.programmer import node_image
from test.support.emulated_node import (
    ASK,
    REST,
    Bench,
    assert_says,
    expected,
    hearing,
    in_turn,
    volts,
)

pytestmark = pytest.mark.usefixtures("node_images")
LEAST_S = MCUS[FOUR].chip_ns * 1e-9
GAP_S = 1.8e-3
FRAMES = 40
LONGEST = MCUS[FOUR].order
WIRES = {"own": False, "data": True}


def shaped(period_s: float | None = None, **options: object) -> FrameSpec:
    """A skin whose frames leave the least gap, unless a period is given."""
    spec = FrameSpec(**({"order": 16, "nodes": 8, "frame_period_s": 1.0} | options))  # type: ignore[arg-type]
    return replace(spec, frame_period_s=period_s or np.ceil((spec.frame_s + GAP_S) * 1e6) / 1e6)


SHAPES = {
    "paper": shaped(first_row=0, sign_seed=None),
    "8 bits": shaped(bits=8),
    "9 bits, parity, Paley": shaped(order=12, bits=9, parity=True),
    "restarts": shaped(nodes=31, order=32, bits=8, resync_chips=32, guard_chips=2),
    "restarts within bits": shaped(resync_chips=25, guard_chips=3),
    "restarts within bits, scrambled": shaped(order=20, nodes=19, chip_s=LEAST_S, parity=True,
                                              scramble=True, resync_chips=25, guard_chips=3),
    "a restart for each chip": shaped(chip_s=80e-6, bits=8, resync_chips=1, guard_chips=2),
    "least chips": shaped(chip_s=LEAST_S),
    "least chips, scrambled": shaped(order=20, nodes=12, chip_s=LEAST_S, parity=True,
                                     scramble=True),
    "least chips, one octet": shaped(order=8, nodes=4, first_row=1, chip_s=LEAST_S, scramble=True),
    "long rows": shaped(order=LONGEST, nodes=900, bits=8, chip_s=LEAST_S, scramble=True),
    "odd chips": shaped(chip_s=51.237e-6),
    "slow chips": shaped(bits=8, chip_s=1e-3),
}  # fmt: skip


def memory_for(spec: FrameSpec, module: int = 1, **options: int | str | None) -> bytes:
    """The memories of the four sensors, one behind the other."""
    options = {"threshold": 0, "rest": min(REST, 100)} | options
    numbers = range(4 * module - 3, 4 * module + 1)
    return b"".join(node_memory(spec, n, mcu=FOUR, **options) for n in numbers)  # type: ignore[arg-type]


def node_of(
    memory: bytes, *, on_data: bool = False, clock_hz: float = 8e6, image: Path | None = None
) -> Node:
    node = Node(image or IMAGES / f"node-{FOUR}.elf", FOUR, memory, clock_hz=clock_hz)
    return replace(hearing(replace(node, memory=b"")), memory=memory) if on_data else node


def of_data(memory: bytes, spec: FrameSpec) -> bytes:
    size = len(memory) // 4
    parts = [memory[i * size : (i + 1) * size] for i in range(4)]
    return b"".join(hearing(Node(IMAGES, "atmega328p", part)).memory for part in parts)


@pytest.mark.parametrize("wire", WIRES)
@pytest.mark.parametrize("shape", SHAPES)
def test_four_words_of_every_shape(shape: str, wire: str) -> None:
    """Each by its own row, to the cycle; the edges of all four at the same cycles."""
    spec, on_data = SHAPES[shape], WIRES[wire]
    module = spec.nodes // 4
    rng = np.random.default_rng(sum(map(ord, shape)))
    memory = memory_for(spec, module)
    if on_data:
        memory = of_data(memory, spec)
    for clock_hz in (7.21e6, 8e6, 8.77e6):
        with Bench([node_of(memory, on_data=on_data, clock_hz=clock_hz)], spec) as skin:
            first = skin.listen()
            if spec.order == LONGEST:  # it reads its memory while the first pulse comes
                skin.frame(first)
                first += 1
            for number in range(first, 6):
                codes = rng.integers(0, 1 << spec.bits, 4)
                skin.press([volts(int(code), spec.bits) for code in codes])
                start = skin.frame(number)
                together: dict[int, set[int]] = {}
                for sensor, code in enumerate(codes):
                    assert_says(skin, start, int(code), 4 * module - 3 + sensor, sensor)
                    wanted = expected(spec, 4 * module - 4 + sensor, int(code), start)
                    heard = skin.heard(sensor, start)
                    for due, came in zip(wanted["t_ns"], heard["t_ns"], strict=True):
                        together.setdefault(int(due), set()).add(int(came))
                assert {len(times) for times in together.values()} == {1}


def test_each_sensor_speaks_for_itself() -> None:
    """The one that is pressed; nobody at rest; in its heartbeat each at its own turn."""
    spec = shaped()
    memory = memory_for(spec, 2, threshold=1, heartbeat=0)
    with Bench([node_of(memory)], spec) as skin:
        skin.press(volts(100, 10))
        for number, pressed in enumerate((0, 1, 2, 3, 1), skin.listen(6)):
            skin.press([volts(600 if sensor == pressed else 100, 10) for sensor in range(4)])
            assert_says(skin, skin.frame(number), 600, 5 + pressed, pressed)
            skin.press(volts(100, 10))
        for number in range(11, 14):
            last = skin.spoke(skin.frame(number))
        assert last == []
    turns = []
    with Bench([node_of(memory_for(spec, 1, threshold=1, heartbeat=16))], spec) as skin:
        skin.press(volts(100, 10))
        for number in range(40):
            turns.append(skin.spoke(skin.frame(number)))
    told = [(sensor, number) for number, who in enumerate(turns) for sensor in who]
    for sensor in range(4):
        mine = [number for who, number in told if who == sensor]
        assert len(mine) >= 2 and set(np.diff(mine)) == {16}
    assert max(map(len, turns)) == 1


@pytest.mark.parametrize("clock_hz", [7.3e6, 8e6, 8.7e6])
def test_groups_and_everybody_who_is_asked(clock_hz: float) -> None:
    spec = shaped()
    memory = memory_for(spec, 1, threshold=1, heartbeat=0)
    with Bench([node_of(memory, clock_hz=clock_hz)], spec) as skin:
        skin.press(volts(100, 10))
        first = skin.listen(6)
        turns = [ASK, *range(ASK + 4, ASK + 8), 4, 0, ASK + 2, ASK + 3, *range(ASK + 16, ASK + 21)]
        for number, turn in enumerate(turns, first):
            asked = in_turn(range(1, 5), turn) if turn & ASK else []
            assert skin.spoke(skin.frame(number, turn=turn)) == asked
        number = first + len(turns)
        for sensor in range(4):  # by their numbers
            turn = 1 | (sensor + 1) << 5
            assert skin.spoke(skin.frame(number + sensor, turn=turn)) == [sensor]
        skin.press(volts(300, 10))
        for later, turn in enumerate([4, 5, 6, 7], number + 4):
            assert skin.spoke(skin.frame(later, turn=turn)) == in_turn(range(1, 5), turn)


@pytest.mark.parametrize(
    ("fault", "blinks"), [("damaged", 2), ("strange", 3), ("another skin", 3), ("cut", 1)]
)
def test_a_node_without_four_memories_of_one_skin_is_silent(fault: str, blinks: int) -> None:
    spec = shaped()
    good = memory_for(spec)
    size = len(good) // 4
    other = memory_for(replace(spec, scramble=True))
    memory = {
        "damaged": good[:-1] + bytes([good[-1] ^ 1]),
        "strange": good[: 3 * size] + memory_for(spec, 2)[:size],
        "another skin": good[: 3 * size] + other[3 * size :],
        "cut": good[: 3 * size],
    }[fault]
    with Bench([node_of(memory)], spec) as skin:
        seen, lit = 0, False
        for step in range(1, round((0.5 * blinks + 1) / 0.05)):  # the first row of blinks
            skin.run(step * 50_000_000)
            seen, lit = seen + (skin.led(0) and not lit), skin.led(0)
        assert seen == blinks
        assert all(len(skin.edges(sensor)) == 0 for sensor in range(4))


def test_a_boot_loader_writes_the_four_memories_to_flash(tmp_path: Path) -> None:
    spec = shaped()
    image = tmp_path / "node.hex"
    image.write_text(node_image(FOUR, [memory_for(spec, 2)], 8, None))
    with Bench([node_of(b"", image=image)], spec) as skin:
        number = skin.listen()
        skin.press([volts(code, 10) for code in (1, 200, 700, 1020)])
        start = skin.frame(number)
        for sensor, code in enumerate((1, 200, 700, 1020)):
            assert_says(skin, start, code, 5 + sensor, sensor)


@pytest.mark.parametrize("wire", [OWN, DATA])
def test_a_skin_of_four_nodes_is_sixteen_taxels(wire: str) -> None:
    """Every word of every frame as its channel was given, by the driver."""
    config = SkinConfig.of(read_file(PARAMS) | {"sync_wire": wire})
    trial, edges = on_virtual_board(config, FOUR, FRAMES)
    assert (trial.wrong, trial.silent, trial.lost_samples) == (0, 0, 0)
    assert trial.frames >= FRAMES
    assert 0 < edges.jitter_us < 0.3
