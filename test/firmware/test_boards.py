# SPDX-License-Identifier: Apache-2.0

"""The boards: pins are the firmware's, values the calculator's, parts fast, all connected."""

import csv
import math
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import make_boards
from amplifier import FrontEnd, Stage, design
from circuit import GUARD_OHM, INPUT_OHM
from kicad import BOARDS, LAYOUTS, KicadError, check
from kicad import netlist as kicads_netlist
from layout import Copper, nets, read_board, unconnected
from netlist import Netlist, read
from order import STRIPS, open_points, placement_csv
from parts import OPAMPS, TYPICAL, part
from parts_list import assembly_csv
from pulse import OVERLOAD_S, pulled
from pulse_spice import PULL_OHM
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from test.support.firmware import FIRMWARE, KICAD, needs_kicad, needs_ngspice
from test.support.programs import run_python

ROOT = FIRMWARE.parent
PROGRAM = FIRMWARE / "boards" / "make_boards.py"
NODES = {"strip": "PB1", "strip-four": "PD2", "strip-fast": "PD1"}
"""The pin of the line, or of the first sensor's, by strip."""
FOUR = "strip-four"
DIGITIZERS = ("digitizer", "digitizer-fast")
UNITS = {"": 1.0, "k": 1e3, "u": 1e-6, "n": 1e-9, "p": 1e-12}
PACKAGES = {  # pin numbers as KiCad's own library of symbols has them
    "ATmega328P-M": (
        "PD3 PD4 GND VCC GND VCC PB6 PB7 PD5 PD6 PD7 PB0 PB1 PB2 PB3 PB4 PB5 AVCC ADC6 AREF GND "
        "ADC7 PC0 PC1 PC2 PC3 PC4 PC5 PC6 PD0 PD1 PD2 GND"
    ),
    "ATmega328P-MM": (
        "PD3 PD4 VCC GND PB6 PB7 PD5 PD6 PD7 PB0 PB1 PB2 PB3 PB4 PB5 AVCC AREF GND "
        "PC0 PC1 PC2 PC3 PC4 PC5 PC6 PD0 PD1 PD2 GND"
    ),
    "Pico": (
        "GPIO0 GPIO1 GND GPIO2 GPIO3 GPIO4 GPIO5 GND GPIO6 GPIO7 GPIO8 GPIO9 GND GPIO10 GPIO11 "
        "GPIO12 GPIO13 GND GPIO14 GPIO15 GPIO16 GPIO17 GND GPIO18 GPIO19 GPIO20 GPIO21 GND GPIO22 "
        "RUN GPIO26 GPIO27 AGND GPIO28 ADC_VREF 3V3 3V3_EN GND VSYS VBUS"
    ),
    "OpAmp": "OUT V- + - V+",
    "74LVC1G17": "NC A GND Y VCC",
    "TLV1117LV33": "GND OUT IN",
    "REF3033": "IN OUT GND",
    "BSS138": "G S D",
    "LED": "K A",
    "Clamp": "K A",
    "SRV05-4": "IO1 GND IO2 IO3 VCC IO4",
    "BAV99": "A K AK",
}


@pytest.fixture(scope="module")
def boards() -> dict[str, Netlist]:
    return {board: read(KICAD / f"{board}.kicad_sch") for board in BOARDS}


def front_of(nodes: int) -> FrontEnd:
    """The design of the skin in a parameter file, or of `nodes` slow ones."""
    values = {"nodes": nodes, "frame_period_ms": 36.0}
    if nodes == 900:
        values = read_file(ROOT / "config" / "thousand_skin.yaml")
    config = SkinConfig.of(values)
    return design(config.spec, config.samples_per_chip)


def front_for(board: str) -> FrontEnd:
    return front_of(900 if board in ("strip-fast", "digitizer-fast", "group") else 16)


def stage_of(board: str) -> Stage:
    """Of the amplifier on a board."""
    front = front_for(board)
    stage = front.groups_stage if board == "digitizer-fast" else front.nodes_stage
    assert stage is not None
    return stage


def value(board: Netlist, reference: str) -> float:
    """Of a resistor or capacitor, Ω or F."""
    number, letter = re.match(r"([0-9.]+)([a-z]?)", board.components[reference].value).groups()
    return float(number) * UNITS[letter]


def pin_at(board: Netlist, reference: str, name: str) -> str:
    """The number of the pin of this name, or of the port among its names."""
    (number,) = [
        number for number, its in board.components[reference].pins.items() if name in its.split("/")
    ]
    return number


def one(board: Netlist, symbol: str) -> str:
    """The reference of the only part with this symbol."""
    (reference,) = [r for r, c in board.components.items() if c.symbol == symbol]
    return reference


def beyond(board: Netlist, net: frozenset[tuple[str, str]], symbol: str) -> dict[str, frozenset]:
    """Parts of two pins at a net, with what is at their other pin."""
    found = {}
    for reference, number in net:
        if board.components[reference].symbol == symbol:
            found[reference] = board.net(reference, {"1": "2", "2": "1"}[number])
    return found


def across(board: Netlist, symbol: str, one_net: frozenset, other: frozenset) -> float:
    """The value of the only part of two pins between two nets."""
    ((reference, _),) = [
        (r, net) for r, net in beyond(board, one_net, symbol).items() if net == other
    ]
    return value(board, reference)


def nodes_of(board: Netlist) -> list[str]:
    """The microcontrollers of a strip."""
    return sorted(r for r, c in board.components.items() if c.symbol.startswith("ATmega328P-M"))


# Files


@pytest.mark.parametrize("program", [PROGRAM, PROGRAM.with_name("combs.py")])
def test_generated_files_are_fresh(program: Path) -> None:
    result = run_python(program, "--check")
    assert result.returncode == 0, result.stdout + result.stderr


def test_without_kicad_it_says_that_only_connections_were_checked() -> None:
    result = run_python(PROGRAM, env={"PATH": "", "PYTHONPATH": str(ROOT)})
    told, counts = result.stdout.splitlines()
    assert "no kicad-cli" in told and counts == "boards=7 layouts=5 unconnected=0"
    assert result.returncode == 0, result.stderr


def instead(old: str, new: str) -> Callable[[str], str]:
    """A text with something else in the first place of `old`."""
    return lambda text: text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("file", "damage", "told"),
    [
        ("electrodes.kicad_pcb", None, "No such file"),
        ("electrodes.kicad_pcb", lambda text: text[: len(text) // 2], "is it truncated?"),
        ("electrodes.kicad_pcb", lambda _: "PK\x03\x04", "was it written by KiCad?"),
        ("electrodes.kicad_pcb", instead("20241229", "20171130"), "save it with"),
        ("electrodes.kicad_pcb", instead("(at ", "(at x"), "line 101: (at …): 'x10.5'"),
        ("electrodes.kicad_pcb", lambda text: f"{text})", "brackets do not match"),
        ("electrodes.kicad_pcb", instead("(net_name", "(name"), "no (net_name"),
        ("digitizer.kicad_pcb", lambda text: text[: text.find("(footprint")] + ")", "no net of"),
        ("node.kicad_sch", instead('"34k"', '"34q"'), "R4: '34q' is no value"),
        ("node.kicad_sch", instead('(lib_id "', '(lib_id "x'), "not in (lib_symb"),
        ("group.kicad_sch", instead('"GND"', '"GND'), "a text in it does not"),
        ("strip.kicad_sch", instead("node.kic", "strip.kic"), "within itself"),
    ],
)
def test_what_is_amiss_in_a_file_is_named(
    file: str,
    damage: Callable[[str], str] | None,
    told: str,
    kicad_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = kicad_folder / file
    if damage is None:
        path.unlink()
    else:
        text = path.read_text()
        path.write_text(damage(text))
        assert path.read_text() != text
    monkeypatch.setattr(make_boards, "KICAD", kicad_folder)
    monkeypatch.setattr(make_boards, "BOARDS", [path.stem.replace("node", "strip")])  # others: slow
    monkeypatch.setattr(make_boards, "LAYOUTS", [path.stem] if "pcb" in file else [])
    monkeypatch.setattr(sys, "argv", ["make_boards.py"])
    assert make_boards.main() == 1
    said = capsys.readouterr()
    assert said.out == "" and file in said.err and told in said.err
    assert (said.err.count("\n") == 1 or "no net of" in told) and said.err.startswith("boards: ")


@pytest.fixture
def kicad_folder(tmp_path: Path) -> Path:
    """A copy of the boards' folder: KiCad writes into the one that it works in."""
    ignored = shutil.ignore_patterns("tmp*", ".*")
    return Path(shutil.copytree(KICAD, tmp_path / "kicad", ignore=ignored))


@needs_kicad
def test_kicads_rules_find_nothing(kicad_folder: Path) -> None:
    assert check(kicad_folder) == "boards=7 layouts=5 erc=0 drc=0 unconnected=0"


@needs_kicad
@pytest.mark.parametrize(
    ("board", "missing", "told"),
    [
        ("digitizer.kicad_sch", r"\n\(wire [^\n]*", "not connected"),
        ("electrodes.kicad_pcb", r"(?s)\n\t\(segment\n.*?\n\t\)", "unconnected_items"),
    ],
)
def test_kicads_rules_find_what_is_missing(
    board: str, missing: str, told: str, kicad_folder: Path
) -> None:
    file = kicad_folder / board
    file.write_text(re.sub(missing, "", file.read_text(), count=1))
    with pytest.raises(KicadError, match=told):
        check(kicad_folder)


@needs_kicad
@pytest.mark.parametrize("board", BOARDS)
def test_nets_are_those_that_kicad_finds(
    board: str, boards: dict[str, Netlist], kicad_folder: Path
) -> None:
    kicads = {
        frozenset((node.get("ref"), node.get("pin")) for node in net.iter("node"))
        for net in ElementTree.fromstring(kicads_netlist(kicad_folder, board)).iter("net")
    }
    assert set(boards[board].nets) == kicads


# Pins


@pytest.mark.parametrize("symbol", PACKAGES)
def test_pins_are_those_of_the_package(symbol: str, boards: dict[str, Netlist]) -> None:
    found = [c for b in boards.values() for c in b.components.values() if c.symbol == symbol]
    assert found
    for component in found:
        names = [component.pins[str(i + 1)].split("/")[0] for i in range(len(component.pins))]
        assert names == PACKAGES[symbol].split()


def lines_of(strip: str) -> tuple[list[str], list[str]]:
    """The pins of a node's lines and sensors, as the header of the microcontroller defines them."""
    header = (FIRMWARE / "node" / "atmega328p.h").read_text()
    if strip != FOUR:
        defined = re.search(r"#define BOARD_LINE (P\w+)", header)
        assert defined and defined[1] == NODES["strip"]
        assert f"NODE_FAST the line is on {NODES['strip-fast']} (TXD)" in header
        assert "sensor on PC0 (ADC0)" in header
        return [NODES[strip]], ["PC0"]
    first = re.search(r"#define BOARD_FIRST_LINE PD(\d)", header)
    words = " ".join(header.replace("*", "").split())
    assert first and "four sensors, on PC0 to PC3, and four lines, on PD2 to PD5" in words
    return [f"PD{int(first[1]) + i}" for i in range(4)], [f"PC{i}" for i in range(4)]


@pytest.mark.parametrize("strip", NODES)
def test_a_nodes_pins_are_those_of_its_firmware(strip: str, boards: dict[str, Netlist]) -> None:
    board = boards[strip]
    header = (FIRMWARE / "node" / "atmega328p.h").read_text()
    defined = dict(re.findall(r"#define BOARD_(SYNC|LED|AIN1) (P[A-D][0-7])", header))
    line_pins, sensor_pins = lines_of(strip)
    on_data = "SYNC" not in board.names  # AIN1 hears pulses behind the first line's resistor
    assert on_data == (strip != "strip-fast")
    nodes = nodes_of(board)
    assert len(nodes) * len(sensor_pins) == 8
    for place, mcu in enumerate(nodes):
        pins = {name: board.net(mcu, pin_at(board, mcu, name)) for name in ("PB1", "PD1", "PD4")}
        lines = [board.net(mcu, pin_at(board, mcu, name)) for name in line_pins]
        assert [len(line) for line in lines] == [2 + on_data] + [2] * (len(lines) - 1)
        for line in lines:
            assert [*beyond(board, line, "R").values()] == [board.names["LINE"]]
        others = [net for name, net in pins.items() if name not in line_pins]
        assert all(len(net) == 1 for net in others)  # another image's line, and XCK
        hears = board.net(mcu, pin_at(board, mcu, defined["AIN1" if on_data else "SYNC"]))
        assert hears == (lines[0] if on_data else board.names["SYNC"])
        sensors = [sensor_at(board, mcu, name) for name in sensor_pins]
        assert sensors == [f"J{place + 1}0{i + 1}" for i in range(len(sensors))], "in their order"
        led = board.net(mcu, pin_at(board, mcu, defined["SYNC" if on_data else "LED"]))
        ((_, anode),) = beyond(board, led, "R").items()
        (diode,) = [r for r, _ in anode if board.components[r].symbol == "LED"]
        assert (diode, "2") in anode and board.net(diode, "K") == board.names["GND"]
        for number, name in board.components[mcu].pins.items():
            if name in ("VCC", "AVCC", "GND"):
                assert board.net(mcu, number) == board.names["GND" if name == "GND" else "+3V3"]
        crystals = [c for c in board.components.values() if c.symbol == "Crystal"]
        assert len(crystals) == (8 if strip == "strip-fast" else 0)
        reference = board.net(mcu, "AREF")
        assert [board.components[r].symbol for r, _ in reference if r != mcu] == ["C"]


def sensor_at(board: Netlist, mcu: str, name: str) -> str:
    """The sensor behind a pin; all that has to be between them is checked."""
    sense = board.net(mcu, pin_at(board, mcu, name))
    assert board.names["GND"] in beyond(board, sense, "C").values()
    ((guard, touched),) = beyond(board, sense, "R").items()  # a discharge goes to the clamp
    assert value(board, guard) == 1e3
    (clamp,) = [r for r, _ in touched if board.components[r].symbol == "Clamp"]
    assert (clamp, "1") in touched and board.net(clamp, "A") == board.names["GND"]
    (sensor,) = [r for r, _ in touched if board.components[r].symbol == "Sensor"]
    assert board.net(sensor, "GND") == board.names["GND"]
    assert board.names["+3V3"] in beyond(board, touched, "R").values()
    return sensor


def test_the_fast_nodes_line_has_no_pull_up_and_its_clock_is_an_output() -> None:
    """In the firmware: PD1 and PD4 are not among the pins that it pulls up, PD4 is driven."""
    source = (FIRMWARE / "node" / "atmega328p.c").read_text()
    fast = source.partition("#ifdef NODE_FAST")[2].partition("#else")[0]
    assert re.search(r"PORTD = \(uint8_t\)~\(.*_BV\(PD1\).*_BV\(PD4\)", fast)
    assert re.search(r"DDRD = .*_BV\(PD4\)", fast)
    note = (KICAD / "node-fast.kicad_sch").read_text()
    assert "pull-up is off" in note and "PD4 (XCK) is an output" in note


@pytest.mark.parametrize("name", DIGITIZERS)
def test_a_digitizers_pins_are_those_of_its_firmware(name: str, boards: dict[str, Netlist]) -> None:
    board, pico = boards[name], one(boards[name], "Pico")
    header = (FIRMWARE / "digitizer" / "rp2040" / "rp2040.h").read_text()
    gpio = {key: int(n) for key, n in re.findall(r"PIN_(\w+) = (\d+)", header)}
    line, sync = (board.net(pico, f"GPIO{gpio[key]}") for key in ("LINE", "SYNC"))
    amplifier = one(board, "OpAmp")
    assert board.net(amplifier, "OUT") in beyond(board, line, "R").values()
    assert board.names["GND"] in beyond(board, line, "C").values()
    assert board.names["GND"] in beyond(board, sync, "R").values()  # low while the board starts
    if name == "digitizer":  # whose pulses pull the line low
        gate = one(board, "BSS138")
        assert (gate, pin_at(board, gate, "G")) in sync
        assert board.net(gate, "S") == board.names["GND"]
        assert across(board, "R", board.net(gate, "D"), board.names["LINE"]) == PULL_OHM
    else:
        buffer = one(board, "74LVC1G17")
        assert (buffer, pin_at(board, buffer, "A")) in sync
        (begun,) = beyond(board, board.net(buffer, "Y"), "R").values()
        assert begun == board.names["SYNC"]
    uart = one(board, "UART")
    assert (uart, pin_at(board, uart, "TX")) in board.net(pico, f"GPIO{gpio['UART_TX']}")
    assert (uart, pin_at(board, uart, "RX")) in board.net(pico, f"GPIO{gpio['UART_RX']}")
    used = {(pico, number) for net in (line, sync) for r, number in net if r == pico}
    assert len(used) == 2
    reference = board.net(pico, "ADC_VREF")
    supply = board.net(amplifier, "V+")
    assert reference == supply != board.net(pico, "3V3")
    assert board.net(pico, "AGND") == board.names["GND"]
    feeds = board.net(pico, f"GPIO{gpio['FEEDS']}")
    if name == "digitizer":  # which feeds strips from USB, through a fuse
        assert feeds == board.names["GND"]
        assert board.names["+5V"] in beyond(board, board.net(pico, "VBUS"), "Fuse").values()
    else:  # whose groups have a supply of their own
        assert len(feeds) == 1
        assert board.net(pico, "VBUS") == board.names["+5V"]


def test_a_second_clamp_is_before_the_op_amp(boards: dict[str, Netlist]) -> None:
    """Connector and first clamp, 68 Ω, second clamp to the op-amp's own supply, 150 Ω, input."""
    board = boards["digitizer"]
    amplifier, second = one(board, "OpAmp"), one(board, "BAV99")
    line, summing, minus = board.names["LINE"], board.net(second, "AK"), board.net(amplifier, "-")
    assert board.net(one(board, "SRV05-4"), "IO1") == board.net(one(board, "Skin3"), "LINE") == line
    assert across(board, "R", line, summing) == GUARD_OHM
    assert across(board, "R", summing, minus) == INPUT_OHM
    assert len(minus) == 2
    assert board.net(second, "K") == board.net(amplifier, "V+")
    assert board.net(second, "A") == board.names["GND"]


@pytest.mark.parametrize("board", BOARDS)
def test_every_amplifier_and_buffer_is_supplied(board: str, boards: dict[str, Netlist]) -> None:
    netlist = boards[board]
    for reference, component in netlist.components.items():
        for name in ("V-", "GND"):
            if name in component.pins.values() and not component.symbol.startswith(("Pico", "ATm")):
                numbers = [n for n, its in component.pins.items() if its == name]
                assert all(netlist.net(reference, n) == netlist.names["GND"] for n in numbers)
        for name in ("V+", "VCC"):
            if name in component.pins.values() and component.symbol in ("OpAmp", "74LVC1G17"):
                net = netlist.net(reference, name)
                assert net in (netlist.names.get("+3V3"), netlist.names.get("+3V3A"))
                assert netlist.names["GND"] in beyond(netlist, net, "C").values()


CABLES = {
    ("strip", FOUR, "digitizer"): ("+3V3", "GND", "LINE"),
    ("strip-fast", "group"): ("+3V3", "GND", "LINE", "GND", "SYNC", "GND"),
}


@pytest.mark.parametrize("names", CABLES)
def test_cables_of_strips_digitizer_and_group_agree(
    names: tuple[str, ...], boards: dict[str, Netlist]
) -> None:
    """And ground is next to line and sync."""
    pins = {
        tuple(c.pins[str(i + 1)] for i in range(len(c.pins)))
        for name in names
        for c in boards[name].components.values()
        if c.symbol.startswith("Skin")
    }
    assert pins == {CABLES[names]}
    for name in names:
        board = boards[name]
        for reference, component in board.components.items():
            if component.symbol.startswith("Skin"):
                for number, net in component.pins.items():
                    assert (reference, number) in board.names[net], (name, net)


# Values


@pytest.mark.parametrize("strip", NODES)
def test_a_nodes_values_are_the_calculators(strip: str, boards: dict[str, Netlist]) -> None:
    board, front = boards[strip], front_for(strip)
    for mcu in nodes_of(board):
        for pin in lines_of(strip)[0]:
            line = board.net(mcu, pin_at(board, mcu, pin))
            into_line = across(board, "R", line, board.names["LINE"])
            assert into_line == pytest.approx(front.nodes_stage.input_ohm)


@pytest.mark.parametrize("strip", ["strip", FOUR])
def test_64_nodes_differ_where_the_schematic_says_so(
    strip: str, boards: dict[str, Netlist]
) -> None:
    few, more = front_of(16), front_of(64)
    same = ("filter_ohm", "filter_f")
    assert all(getattr(few, name) == getattr(more, name) for name in same)
    assert few.nodes_stage.feedback_ohm == more.nodes_stage.feedback_ohm
    assert few.nodes_stage.feedback_f == more.nodes_stage.feedback_f
    board = boards[strip]
    noted = [c for c in board.components.values() if "64 nodes" in c.fields.get("Note", "")]
    assert len(noted) == 8
    for component in noted:
        assert (component.reference, "2") in board.names["LINE"]
        ohm = re.match(r"([0-9.]+)k: 64 nodes", component.fields["Note"])
        assert ohm and float(ohm[1]) * 1e3 == pytest.approx(more.nodes_stage.input_ohm)
        assert component.fields["MPN64"] == part("R", f"{ohm[1]}k").number


@pytest.mark.parametrize("name", [*DIGITIZERS, "group"])
def test_an_amplifiers_values_are_the_calculators(name: str, boards: dict[str, Netlist]) -> None:
    board, stage = boards[name], stage_of(name)
    amplifier = one(board, "OpAmp")
    summing, out, half = (board.net(amplifier, pin) for pin in ("-", "OUT", "+"))
    line, held = summing, summing
    if name == "digitizer":  # which has a second clamp
        line, held = board.names["LINE"], board.names["SUM"]
    assert across(board, "R", line, out) == pytest.approx(stage.feedback_ohm)
    assert across(board, "C", held, out) == pytest.approx(stage.feedback_f)
    dividers = beyond(board, half, "R")
    supply = board.net(amplifier, "V+")
    assert set(dividers.values()) == {supply, board.names["GND"]} and len(dividers) == 2
    for reference in dividers:
        component = board.components[reference]
        assert (component.value, component.fields["MPN"]) == ("10k", "RC0402FR-0710KL")
    assert across(board, "C", half, board.names["GND"]) == pytest.approx(10e-12)


@pytest.mark.parametrize("name", DIGITIZERS)
def test_a_filters_values_are_the_calculators(name: str, boards: dict[str, Netlist]) -> None:
    board, front = boards[name], front_for(name)
    line = board.net(one(board, "Pico"), "GPIO26")
    assert across(board, "R", board.net(one(board, "OpAmp"), "OUT"), line) == front.filter_ohm
    assert across(board, "C", line, board.names["GND"]) == pytest.approx(front.filter_f)


def test_every_group_is_added_up_and_gets_the_sync(boards: dict[str, Netlist]) -> None:
    board, stage = boards["digitizer-fast"], stage_of("digitizer-fast")
    summing = board.net(one(board, "OpAmp"), "-")
    cables = [r for r, c in board.components.items() if c.symbol == "Group"]
    assert len(cables) == stage.inputs
    for cable in cables:
        assert across(board, "R", board.net(cable, "OUT"), summing) == stage.input_ohm
        assert (cable, pin_at(board, cable, "SYNC")) in board.names["SYNC"]


def test_a_group_has_supply_half_and_sync_buffer_of_its_own(boards: dict[str, Netlist]) -> None:
    board = boards["group"]
    regulator, buffer, cable = (one(board, s) for s in ("TLV1117LV33", "74LVC1G17", "GroupEnd"))
    assert board.net(regulator, "OUT") == board.names["+3V3"]
    assert board.net(regulator, "IN") == board.names["+5V"]
    assert (buffer, "2") in board.net(cable, "SYNC")
    (begun,) = beyond(board, board.net(buffer, "Y"), "R").values()
    assert begun == board.names["SYNC"] != board.net(cable, "SYNC")
    series = across(board, "R", board.net(one(board, "OpAmp"), "OUT"), board.net(cable, "OUT"))
    assert series < 0.005 * stage_of("digitizer-fast").input_ohm  # does not change A
    large = [c for c in board.components.values() if c.value == "100u"]
    assert len(large) == 1


# Parts


def test_op_amps_are_as_fast_as_the_calculator_asks() -> None:
    few, more = (pulled(front_of(nodes)) for nodes in (16, 64))  # more than chips alone need
    many = front_of(900)
    uses = [
        ("amplifier", few, few.nodes_stage),
        ("amplifier", more, more.nodes_stage),
        ("group amplifier", many, many.nodes_stage),
        ("sum", many, stage_of("digitizer-fast")),
    ]
    assert {use for use, _, _ in uses} == OPAMPS.keys()
    for use, front, stage in uses:
        assert OPAMPS[use].gain_bandwidth_hz >= TYPICAL * stage.gain_bandwidth_hz
        assert OPAMPS[use].slew_v_per_s >= TYPICAL * front.slew_v_per_s
        assert OPAMPS[use].rail_to_rail
    assert OPAMPS["amplifier"].overload_s < OVERLOAD_S


def test_the_parts_list_counts_what_the_boards_show(boards: dict[str, Netlist]) -> None:
    """Against counts by hand: 16 nodes on 2 strips; 12 groups of 70 on 9 strips, one of 60 on 8."""
    with (FIRMWARE / "boards" / "parts.csv").open(newline="") as file:
        rows = {row["number"]: row for row in csv.DictReader(file)}
    assert len(rows) > 40

    def count(number: str) -> tuple[int, ...]:
        return tuple(int(rows[number][f"for_{n}_nodes"]) for n in (16, 64, 900))

    assert count("ATMEGA328P-MU") == (16, 64, 0)
    assert count("ATMEGA328P-MMH") == (0, 0, 900)
    assert count("SC0915") == (1, 1, 1)
    assert count("BM06B-GHS-TBT") == (0, 0, 2 * (12 * 9 + 8) + 13)
    assert count("BM03B-GHS-TBT") == (2 * 2 + 2, 2 * 8 + 2, 1)  # and the digitizers' UART
    assert count("BSS138LT1G") == (1, 1, 0)
    assert count("BAV99LT1G") == (1, 1, 0)
    assert count("RC0402FR-0795K3L") == (0, 64, 0)
    assert count("RC0402FR-0734KL") == (16, 0, 0)
    assert count("RC0402FR-0710KL") == (16 + 2, 64 + 2, 900 + 2 * 14)
    assert count("X32258MOB4SI") == (0, 0, 900)
    assert count("TLV3541IDBVR") == (0, 0, 14)
    skins = [board for name, board in boards.items() if name != "electrodes"]
    numbers = {c.fields.get("MPN") for board in skins for c in board.components.values()}
    assert numbers - {None} <= rows.keys()


@pytest.mark.parametrize(
    ("symbol", "value", "number"),
    [
        *(("R", "820", "RC0402FR-07820RL"), ("R", "3.9k", "RC0402FR-073K9L")),
        *(("R", "33", "RC0402FR-0733RL"), ("R", "100k", "RC0402FR-07100KL")),
        *(("C", "220p", "GRM1555C1H221JA01D"), ("C", "10p", "GRM1555C1H100JA01D")),
        *(("C", "1n", "GRM1555C1H102JA01D"), ("C", "100n", "GRM155R71C104KA88D")),
    ],
)
def test_numbers_of_resistors_and_capacitors(symbol: str, value: str, number: str) -> None:
    assert part(symbol, value).number == number


# Layouts


@pytest.fixture(scope="module")
def layouts() -> dict[str, list[Copper]]:
    return {board: read_board(KICAD / f"{board}.kicad_pcb") for board in LAYOUTS}


@pytest.mark.parametrize("board", LAYOUTS)
def test_copper_connects_what_the_schematic_says(
    board: str, boards: dict[str, Netlist], layouts: dict[str, list[Copper]]
) -> None:
    copper = layouts[board]
    assert nets(copper) == set(boards[board].nets)
    assert unconnected(copper) == []


@pytest.mark.parametrize("board", LAYOUTS)
def test_copper_that_is_missing_is_found(board: str, layouts: dict[str, list[Copper]]) -> None:
    """All of it, and of nets without a plane the longest track."""
    copper = layouts[board]
    pads = [item for item in copper if item.kind == "pad"]
    assert {net for net, _ in unconnected(pads)} == {i.net for i in copper if i.kind == "track"} | {
        item.net for item in copper if item.kind == "zone"
    }
    planes = {item.net for item in copper if item.kind == "zone"}
    tracks = {i.net: i for i in copper if i.kind == "track" and i.net not in planes}
    for item in copper:
        if item.net in tracks and item.kind == "track":
            tracks[item.net] = max(tracks[item.net], item, key=lambda i: math.dist(*i.points))
    without = [item for item in copper if tracks.get(item.net) is not item]
    assert {net for net, _ in unconnected(without)} == tracks.keys()


@pytest.mark.parametrize("board", [*STRIPS, "electrodes"])
def test_sensors_are_a_grid_of_the_pitch_that_is_configured(
    board: str, boards: dict[str, Netlist], layouts: dict[str, list[Copper]]
) -> None:
    """Numbered row by row; of the strips two rows of four."""
    sensors = [r for r, c in boards[board].components.items() if c.symbol == "Sensor"]
    sensors.sort(key=lambda reference: int(reference[1:]))
    files = {"electrodes": "skin.yaml", "strip-fast": "patch_72.yaml"}
    file = files.get(board, "wired_skin.yaml")
    pitch_mm = read_file(ROOT / "config" / file).get("pitch_mm")
    middles = np.array([_middle(layouts[board], reference) for reference in sensors])
    places = np.array([divmod(i, 4)[::-1] for i in range(len(sensors))])  # column, row
    np.testing.assert_allclose(middles - middles[0], places * pitch_mm, atol=1e-6)


def test_without_its_tail_a_strip_is_whole_and_its_ends_meet_the_next_ones(
    layouts: dict[str, list[Copper]],
) -> None:
    """Of fast nodes, beyond x = 0: line and sync reach all nodes, and pads for wires."""
    pads = [item for item in layouts["strip-fast"] if item.kind == "pad"]
    tail = {item.terminal[0] for item in pads if item.terminal and item.points[0][0] < 0}
    assert tail == {"J1", "J2", "D1"}
    for net in ("LINE", "SYNC"):
        kept = [_beyond(item) for item in layouts["strip-fast"] if item.net == net]
        copper = [
            item for item in kept if item and (not item.terminal or item.terminal[0] not in tail)
        ]
        ends = [item for item in copper if item.kind == "pad" and not item.terminal]
        named = [replace(item, terminal=("end", str(i))) for i, item in enumerate(ends)]
        assert unconnected([item for item in copper if item not in ends] + named) == []
        (x0, y0), (x1, y1) = sorted(item.points[0] for item in ends)
        assert y0 == y1 and 0 < x0 + 40 - x1 < 1.5


def _beyond(item: Copper) -> Copper | None:
    """What is left of a pad, a via or a track that is cut at x = 0."""
    points = sorted(item.points)
    if points[-1][0] <= 0:
        return None
    if item.kind != "track" or points[0][0] >= 0:
        return item
    (x0, y0), (x1, y1) = points
    return replace(item, points=((0.0, y0 - x0 * (y1 - y0) / (x1 - x0)), (x1, y1)))


def _middle(copper: list[Copper], reference: str) -> np.ndarray:
    """Of a sensor's ring: x, y."""
    pads = [item for item in copper if item.terminal == (reference, "2")]
    points, halves = np.array([i.points[0] for i in pads]), np.array([i.half for i in pads])
    middle: np.ndarray = ((points - halves).min(axis=0) + (points + halves).max(axis=0)) / 2
    return middle


@pytest.mark.parametrize("strip", STRIPS)
def test_an_assembly_list_has_every_part_once(strip: str, boards: dict[str, Netlist]) -> None:
    rows = [*csv.DictReader(assembly_csv(KICAD / f"{strip}.kicad_sch").splitlines())]
    places = [place for row in rows for place in row["Designator"].split(",")]
    bought = [r for r, c in boards[strip].components.items() if "MPN" in c.fields]
    assert sorted(places) == sorted(bought)
    assert sum(int(row["Quantity"]) for row in rows) == len(places)
    resistors = [row for row in rows if row["Designator"].startswith("R")]
    assert all("1 %" in row["Comment"] for row in resistors), "5 % leave the converter's range"
    more = assembly_csv(KICAD / f"{strip}.kicad_sch", 64)
    number = "RC0402FR-07102KL" if strip == "strip-fast" else "RC0402FR-0795K3L"
    assert f"{number},8," in more and "RC0402FR-0734KL" not in more


def test_an_order_names_what_is_not_placed_or_has_no_number(boards: dict[str, Netlist]) -> None:
    board = boards["digitizer"]
    rows = [
        {"Ref": r, "PosX": "1.5", "PosY": "-20.25", "Rot": "-90", "Side": "bottom"}
        for r in board.components
    ]
    order = open_points(board, rows)
    assert not order.without_number and not order.unplaced
    assert "RC0402FR-07910RL" in order.unverified and "BSS138LT1G" not in order.unverified
    assert open_points(board, rows[1:]).unplaced == {rows[0]["Ref"]}
    nameless = replace(board.components["F1"], fields={})
    bare = replace(board, components=board.components | {"F1": nameless})
    assert open_points(bare, rows).without_number == {"F1"}
    assert placement_csv([*rows, {"Ref": "TP1"}], {"C1"}).splitlines() == [
        "Designator,Mid X,Mid Y,Layer,Rotation",
        "C1,1.5000,-20.2500,Bottom,270",
    ]


def test_the_clamp_is_the_first_on_the_line_and_test_points_are_on_its_nets(
    layouts: dict[str, list[Copper]],
) -> None:
    """Copper of the line without the clamp's pad: the connector is cut off from what leads on."""
    line = [item for item in layouts["digitizer"] if item.net == "/LINE"]
    at_clamp = next(item for item in line if item.terminal == ("D1", "1"))
    rest = [i for i in line if i is not at_clamp and not _ends_at(i, at_clamp.points[0])]
    [(_, parts)] = unconnected(rest)
    (at_connector,) = (part for part in parts if ("J1", "3") in part)
    assert at_connector == {("J1", "3")}
    bare = {item.net for item in layouts["digitizer"] if item.kind == "pad" and not item.terminal}
    for strip in STRIPS:
        on_strip = {i.net for i in layouts[strip] if i.kind == "pad" and not i.terminal}
        assert on_strip == {"+3V3", "GND", "LINE", *(["SYNC"] if strip == "strip-fast" else [])}
    assert bare >= {"+5V", "GND", "/LINE", "/PULL", "+3V3", "/HALF"}


def _ends_at(item: Copper, point: tuple[float, float]) -> bool:
    return item.kind == "track" and any(math.dist(end, point) < 0.01 for end in item.points)


# Bring-up


@needs_ngspice
def test_a_sync_edge_is_clean_at_both_ends(boards: dict[str, Netlist]) -> None:
    """A group's, by SPICE: a pin stands 0.5 V above its supply, and is high at 0.6 of it."""
    from scope import SYNC_OHM, sync_edge

    board = boards["group"]
    output = board.net(one(board, "74LVC1G17"), "Y")
    assert across(board, "R", output, board.names["SYNC"]) == SYNC_OHM
    for node in (1, 70):
        edge = sync_edge(70, node, SYNC_OHM)
        assert edge.volts.max() < 3.3 + 0.5
        assert (edge.volts[edge.times > 100e-9] > 0.6 * 3.3).all()


@needs_ngspice
def test_without_its_resistor_a_sync_edge_is_not_clean() -> None:
    from scope import sync_edge

    assert sync_edge(70, 70, 5.0).volts.max() > 3.3 + 0.5
