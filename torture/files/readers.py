# SPDX-License-Identifier: Apache-2.0

"""Readers of files that users name, each with a file that it reads and what must lie beside it."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache, partial
from io import StringIO
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import yaml

from tactile_cdma import Decoder, Frame, LiveObservation, Skin
from tactile_cdma.base.errors import (
    BodyError,
    CalibrationError,
    CaptureError,
    LayoutError,
    NodeMemoryError,
    ParameterError,
    RestError,
    TactileError,
)
from tactile_cdma.calibrating.load_points import read_table
from tactile_cdma.calibrating.load_session import LoadSession
from tactile_cdma.commands.cli import main
from tactile_cdma.config.body_file import read_body
from tactile_cdma.config.parameters import read_file
from tactile_cdma.datasets.episodes import samples_of
from tactile_cdma.datasets.progress import Progress
from tactile_cdma.datasets.sources.opening import Wanted, open_source
from tactile_cdma.hardware.programmer import node_image, read_memory
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.readings.calibration_file import read_any, seal_calibration
from tactile_cdma.recording.offline import RawCapture
from tactile_cdma.recording.recording_file import RecordingParser, describe, is_text, survey
from tactile_cdma.recording.scope_csv import read_scope_csv
from tactile_cdma.rest.rest_file import read_rest
from tactile_cdma.sim.options import SimOptions
from test.support import simulated
from test.support.bags import BagMaker

from ..fuzz import files
from ..fuzz.target import Target

ROOT = Path(__file__).resolve().parent.parent.parent
NODE = "/left/palm/skin"
PARAMETERS = b"""/**:
  ros__parameters: {bits: 10}
/left/*/skin:
  ros__parameters: {nodes: 9}
/**/palm/**:
  ros__parameters: {port: 'sim://'}
"""
BODY = b"""frame_id: torso
patches:
  palm{}:
    repeat: [1, 2]
    parameters: {port: 'sim://', nodes: 9}
"""
LOADS = b"node,pressure_kpa,voltage_v\n1,0,3.3\n1,50,1.65\n2,0,3.2\n"
PROGRAM = b":00000001FF\n"
MESHED = b"""schema: tactile_cdma/layout
version: 1
shape: mesh
%s
rows: 2
columns: 2
pitch_mm: 5
at_mm: [0, 0, 0]
out: [0, 0, 1]
right: [1, 0, 0]
"""
OBJ = b"v -90 -90 0\nv 90 -90 0\nv 90 90 0\nv -90 90 0\nf 1 2 3 4\n"
STL = b"solid flat\nfacet\nouter loop\nvertex -90 -90 0\nvertex 90 -90 0\nvertex 0 90 0\nendloop\n"
URDF = b"""<robot name="hand"><link name="palm"><collision>
<origin xyz="0 0 -0.01"/><geometry><box size="0.2 0.2 0.02"/></geometry>
</collision></link></robot>"""


@dataclass(frozen=True, slots=True)
class Reader:
    """A reader of a file. name: of the file, with folders. beside: other files, by name.

    content: of a file that it reads. refuses: how it may refuse one.
    """

    name: str
    read: Callable[[Path], object]
    content: Callable[[], bytes]
    refuses: type[TactileError] = TactileError
    beside: Callable[[], Mapping[str, bytes]] = dict


def session(path: Path) -> None:
    """Add points to a table, up to the first one: there is no skin."""
    driver: Any = SimpleNamespace(problem="no skin")
    LoadSession(driver, SimpleQueue(), 0.01, [1], 1.0).run(path, [], append=True)


def layout_of(path: Path) -> None:
    """Read the layout beside a file, which refers to it."""
    read_layout(path.parent / "layout.yaml", Wiring())


def capture(path: Path) -> None:
    """Decode raw bytes, or a recording."""
    if not is_text(path):
        for _ in RawCapture(path, {"nodes": files.NODES}).frames():
            pass


def program(path: Path) -> None:
    """Read a node's program, of the user's own."""
    node_image("atmega328p", [bytes(64)], 16, path)


def source(path: Path) -> None:
    """Read all samples of a bag."""
    opened = open_source(path if path.suffix != ".yaml" else path.parent, Wanted(cameras=None))
    with Progress() as progress:
        for _ in samples_of(opened, (), progress):
            pass


def dataset(path: Path) -> None:
    """Observe a skin as a dataset's metadata tell, frame by frame; they may be another skin's."""
    folder, skin, moment_ns = path.parent.parent, _skin(), 1_700_000_000_000_000_000
    Skin("sim://", **LiveObservation.parameters(folder))
    observed = LiveObservation(folder, skin)
    for number, frame in enumerate(_frames()):
        observed.take(frame, stamp_ns=moment_ns + number * 12_800_000)
    assert repr(observed) and all(map(str.isprintable, observed.notes))
    row = observed.at(moment_ns + 500_000_000)
    assert row.keys() == observed.features.keys()


@cache
def _skin() -> Skin:
    return Skin("sim://?scene=all&seed=3", contacts=True)


@cache
def _recording() -> bytes:
    with TemporaryDirectory() as folder:
        options = SimOptions(scene="all", seed=3)
        return simulated.recording(Path(folder, "touch.skin"), options, 1.2).read_bytes()


@cache
def _frames() -> list[Frame]:
    decoder, parser = Decoder(contacts=True), RecordingParser()
    chunks = parser.feed(_recording()) + parser.finish()
    return [frame for chunk in chunks for frame in decoder.feed(chunk.data, chunk.time_ns * 1e-9)]


@cache
def _dataset() -> dict[str, bytes]:
    """The metadata of a dataset, by their files' names."""
    with TemporaryDirectory() as folder, redirect_stdout(StringIO()):
        path = Path(folder, "touch.skin")
        path.write_bytes(_recording())
        assert main(["export", str(path), "--lerobot", f"{folder}/set", "--fps", "20"]) == 0
        return {path.name: path.read_bytes() for path in Path(folder, "set/meta").glob("*.json")}


@cache
def _bag(sqlite: bool) -> dict[str, bytes]:
    """The files of a bag, by their suffixes."""
    with TemporaryDirectory() as folder:
        bag = BagMaker().skin("/skin", 0.5).joints("/joints", 0.5)
        path = bag.write(Path(folder, "bag"), sqlite)
        return {file.suffix: file.read_bytes() for file in path.iterdir()}


def _calibration() -> bytes:
    return next(iter(files.seeds_of_calibrations().values()))


def _in(folder: str, some: Callable[[], Mapping[str, bytes]]) -> Callable[[], dict[str, bytes]]:
    return lambda: {f"{folder}/{name}": content for name, content in some().items()}


READERS = {
    "parameters": Reader(
        "skin.yaml", partial(read_file, node=NODE), lambda: PARAMETERS, ParameterError
    ),
    "layout": Reader(
        "layout.yaml",
        lambda path: read_layout(path, Wiring()),
        lambda: (ROOT / "config/layouts/list.yaml").read_bytes(),
        LayoutError,
    ),
    "stl": Reader(
        "part.stl",
        layout_of,
        lambda: STL,
        LayoutError,
        lambda: {"layout.yaml": MESHED % b"mesh: part.stl"},
    ),
    "obj": Reader(
        "part.obj",
        layout_of,
        lambda: OBJ,
        LayoutError,
        lambda: {"layout.yaml": MESHED % b"mesh: part.obj"},
    ),
    "urdf": Reader(
        "hand.urdf",
        layout_of,
        lambda: URDF,
        LayoutError,
        lambda: {"layout.yaml": MESHED % b"urdf: hand.urdf\nlink: palm"},
    ),
    "body": Reader("body.yaml", read_body, lambda: BODY, BodyError),
    "calibration": Reader("calibration.yaml", read_any, _calibration, CalibrationError),
    "sealed": Reader("calibration.yaml", seal_calibration, _calibration, CalibrationError),
    "loads": Reader("loads.csv", read_table, lambda: LOADS, CalibrationError),
    "session": Reader("loads.csv", session, lambda: LOADS),
    "rest": Reader(
        "skin.rest.yaml", read_rest, lambda: next(iter(files.seeds_of_rests().values())), RestError
    ),
    "recording": Reader("touch.skin", survey, _recording, CaptureError),
    "description": Reader("touch.skin", describe, _recording, CaptureError),
    "capture": Reader(
        "capture.bin", capture, lambda: next(iter(files.seeds_of_captures().values()))
    ),
    "scope": Reader(
        "scope.csv", read_scope_csv, lambda: files.seeds_of_scope()["headed"], CaptureError
    ),
    "mcap": Reader("bag/bag.mcap", source, lambda: _bag(False)[".mcap"], CaptureError),
    "sqlite": Reader("bag/bag.db3", source, lambda: _bag(True)[".db3"], CaptureError),
    "metadata": Reader(
        "bag/metadata.yaml",
        source,
        lambda: _bag(False)[".yaml"],
        CaptureError,
        lambda: {"bag/bag.mcap": _bag(False)[".mcap"]},
    ),
    "info": Reader(
        "set/meta/info.json",
        dataset,
        lambda: _dataset()["info.json"],
        TactileError,
        _in("set/meta", _dataset),
    ),
    "tactile": Reader(
        "set/meta/tactile.json",
        dataset,
        lambda: _dataset()["tactile.json"],
        TactileError,
        _in("set/meta", _dataset),
    ),
    "node": Reader(
        "node.hex", read_memory, lambda: files.seeds_of_memories(".hex")["node"], NodeMemoryError
    ),
    "bytes": Reader(
        "node.bin", read_memory, lambda: files.seeds_of_memories(".bin")["node"], NodeMemoryError
    ),
    "program": Reader("node.hex", program, lambda: PROGRAM, NodeMemoryError),
}
"""Readers by what they read."""


def placed(reader: Reader, folder: Path, make: Callable[[Path], object]) -> Path:
    """Lay out a reader's files in a folder; make: makes the one that is read. Returns its path."""
    path = folder / reader.name
    for name, content in {reader.name: b"", **reader.beside()}.items():
        beside = folder / name
        beside.parent.mkdir(parents=True, exist_ok=True)
        if beside != path:
            beside.write_bytes(content)
    make(path)
    return path


# ---- fuzz targets

ODD: list[Any] = [
    None,
    True,
    -1,
    0,
    1,
    2**70,
    0.5,
    1e999,
    math.nan,
    "",
    "\x1b[2J",
    "../../etc",
    "x" * 9999,
]
ODD += [[], {}, [None], {"a": 1}, [[]] * 99]


def lying(content: bytes, data: bytes) -> bytes:
    """Replace up to three values of a document by odd ones, which ones follows from data."""
    rng, document = random.Random(data), yaml.safe_load(content)
    for _ in range(rng.randint(1, 3)):
        place: Any = document
        while isinstance(place, list | dict) and place:
            key = rng.choice(range(len(place)) if isinstance(place, list) else list(place))
            if not isinstance(place[key], list | dict) or not place[key] or rng.random() < 0.2:
                place[key] = deepcopy(rng.choice(ODD))
                break
            place = place[key]
    return json.dumps(document).encode()


def _target(name: str, is_document: bool = False) -> Target:
    reader = READERS[name]

    def run(data: bytes) -> None:
        content = lying(reader.content(), data) if is_document else data
        reader.read(
            placed(reader, Path(_folder().name, name), lambda path: path.write_bytes(content))
        )

    def seeds() -> dict[str, bytes]:
        return {"none": b""} if is_document else {"whole": reader.content()}

    return Target(name, run, seeds, (reader.refuses,), 1 << 14)


@cache
def _folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="tactile_cdma-")


TARGETS = (
    *(_target(name) for name in ("stl", "obj", "urdf")),
    *(_target(name, is_document=True) for name in ("metadata", "info", "tactile")),
    replace(_target("parameters"), name="sections"),
)
