# SPDX-License-Identifier: Apache-2.0

"""The options of a sim:// URL, and what they make of the frame layout that a host asks for."""

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self
from urllib.parse import urlsplit

import numpy as np

from ..base.errors import SpecError
from ..code.codes import default_order
from ..code.frame import DEFAULT_AMPLITUDE_V, MAX_STRETCH, SPARSE, FrameSpec
from ..config.parameters import (
    BY_NAME,
    DEFAULTS,
    GAP,
    NATURAL_SIGNS,
    Parameter,
    Value,
    check_option,
    parse_options,
)
from ..config.skin_config import FRAME_PARAMETERS, user_path
from ..hardware.node_memory import CHANGE, REST, usual_follow, usual_heartbeat
from ..places.layout import Layout
from ..places.layout_file import read_layout
from ..places.layout_nodes import Wiring
from ..places.layout_shapes import Pitch, across_and_down, is_same, pitch_of, shown_mm
from ..wire._protocol import SyncMode, SyncWire
from .channel import MAX_JITTER, Channel
from .nodes import NodeClocks, NodeRules
from .scene import EXTERNAL, LOADS, SCENES, SkinGeometry
from .sensor import FSR, IDEAL, MOST_HYSTERESIS, MOST_MISMATCH, PAPER, SensorModel

SCHEME = "sim"
USUAL = "usual"
"""Rule by which nodes of these codes speak by default, as `tactile-cdma node` has it."""
BY_THE_SECOND = -1
"""Heartbeat that `tactile-cdma node` gives to a node by default: about once a second."""
MOST_SAMPLES = 1 << 23
"""Samples of a frame period. Chosen, as the next one, so that computing a frame, which nothing can
interrupt, takes a few seconds at most."""
MOST_NODE_CHIPS = 1 << 24
"""Nodes × chips of a frame, for nodes with clocks of their own."""
LARGEST_RATE_ERROR = 0.02
"""Relative error of a node's clock. Chosen: calibrated RC oscillators keep about that."""
LARGEST_DELAY = 1.0
"""Delay of a node, chips. Chosen: a node starts within its first chip."""


@dataclass(frozen=True, slots=True)
class Setup:
    """How a digitizer is set: what CONFIGURE asks for and INFO reports.

    sync: source of the frame marks. integrated: it sends one mean value per chip.
    quiet_uv: largest difference of samples within what it sends as Quiet, µV; 0: never. wire: of
    its pulses.
    """

    spec: FrameSpec = field(default_factory=FrameSpec)
    samples_per_chip: int = 4
    sync: SyncMode = SyncMode.DRIVE
    integrated: bool = False
    quiet_uv: int = 0
    wire: SyncWire = SyncWire.OWN

    def __post_init__(self) -> None:
        if self.spec.resync_chips and self.sync == SyncMode.NONE:
            raise SpecError(
                "nodes that start anew within a frame hear a sync line, which timing 'gap' does "
                "without: set timing to 'line' or resync_chips to 0"
            )
        if self.wire == SyncWire.DATA and self.sync == SyncMode.NONE:
            raise SpecError("timing 'gap' wants quiet gaps: set it to 'line' or sync_wire to 'own'")
        if self.integrated and self.sync == SyncMode.NONE:
            raise SpecError(
                "integrated chips need frame marks, which timing 'gap' does not give: "
                "set timing to 'line' or integrated to 0"
            )

    @property
    def rate_hz(self) -> float:
        """Return values per second: of the samples, or of the chips where they are integrated."""
        return (1 if self.integrated else self.samples_per_chip) / self.spec.chip_s


def _option(default: Value, *about: Any) -> Any:
    """Define the simulator's own option; about: what follows the default in a Parameter."""
    return field(default=default, metadata={"about": (default, *about)})


@dataclass(frozen=True)
class SimOptions:
    """Options of the simulator, named as in its URL; see OPTIONS for meanings and limits.

    Those of the frame layout (nodes … integrated) follow the host's CONFIGURE where they are None,
    and where the taxels are follows `worn`, no option: the layout of the driver that opens it.
    Raises SpecError, naming option, value and limits, for a bad value or combination.
    """

    # fmt: off
    scene: str = _option("demo", "what touches the skin", "", None,
        (*SCENES, *LOADS, EXTERNAL))
    nodes: int | None = None
    bits: int | None = None
    parity: bool | None = None
    order: int | None = None
    chip_us: float | None = None
    frame_period_ms: float | None = None
    first_row: int | None = None
    sign_seed: int | None = None
    scramble: bool | None = None
    codes: str | None = None
    resync_chips: int | None = None
    guard_chips: int | None = None
    drive: str | None = None
    polarity: int | None = None
    samples_per_chip: int | None = None
    timing: str | None = None
    sync_wire: str | None = None
    integrated: bool | None = field(default=None,
        metadata={"about": (False, "send one mean value per chip")})
    amplitude_mv: float = _option(DEFAULT_AMPLITUDE_V * 1e3,
        "level of one node on the digitized line", "mV", (1e-3, 1e5))
    noise: float = _option(0.005, "noise of one sample, rms", "V", (0.0, 100.0))
    offset: float = _option(0.0, "level of the silent line", "V", (-100.0, 100.0))
    stretch: float = _option(0.0,
        "frames last up to this share longer, at random", "", (0.0, MAX_STRETCH))
    jitter: float = _option(0.0,
        "largest displacement of a chip's edge, in chips", "", (0.0, MAX_JITTER))
    clock_spread: float = _option(0.0,
        "largest error of a node's own clock", "", (0.0, LARGEST_RATE_ERROR))
    delay_spread: float = _option(0.0,
        "largest delay of a node after the sync edge", "chips", (0.0, LARGEST_DELAY))
    sensor: str = _option(IDEAL,
        "ideal: the curve alone; paper: lag and hysteresis too; fsr: voltages rise by a power law",
        "", None, (IDEAL, PAPER, FSR))
    hysteresis: float = _option(1.0,
        "factor to the loops of sensor 'paper'", "", (0.0, MOST_HYSTERESIS))
    mismatch: float = _option(0.0, "spread of the taxels' curves, rms", "", (0.0, MOST_MISMATCH))
    warming: float = _option(0.0,
        "largest drift of a sensor's voltage, over minutes", "mV", (0.0, 1e3))
    sensor_noise: float = _option(0.0, "noise at a node's converter, rms", "V", (0.0, 1.0))
    calibration: str = _option("",
        "calibration file whose curves the sensors have, whatever `sensor` says of these")
    dead: str = _option("", "nodes that never send: 3,17")
    dead_after: float = _option(0.0, "time from which these are dead", "s", (0.0, 86_400.0))
    stuck: str = _option("", "nodes that always measure the same: 3,17")
    rail: float = _option(0.0,
        "amplifier's rails about the offset; 0: out of reach", "V", (0.0, 1e4))
    adc_bits: int = _option(12, "resolution of the digitizer", "bit", (4, 16))
    threshold: int = _option(1, "change that makes a node talk; 0: always", "LSB", (0, 65_535))
    speaks: str = _option(USUAL,
        "a node talks while it is off rest (rest), or when its word has changed (change); usual: "
        "change of sparse codes, else rest", "", None, (USUAL, REST, CHANGE))
    heartbeat: int = _option(BY_THE_SECOND,
        "a node talks at least once in so many frames; 0: never, -1: about once a second",
        "", (BY_THE_SECOND, 65_535))
    start_phase: float = _option(0.0,
        "share of the first frame's period that has passed at START", "", (0, 0.99))
    seed: int = _option(0, "of everything random", "", (0, 2**31 - 1))
    speed: float = _option(1.0, "pace; 1: real time, 0: as fast as it is read", "", (0.0, 1000.0))
    rows: int | None = None
    columns: int | None = None
    pitch_mm: Pitch | None = None
    layout: str = _option("", "layout file of the skin; empty: rows, columns, pitch_mm")
    # fmt: on
    worn: Layout | None = None

    def __post_init__(self) -> None:
        for option in OPTIONS:
            value = getattr(self, option.name)
            if value is not None:
                object.__setattr__(self, option.name, check_option(option, value))
        for name, numbers in (("dead", self.sensors.dead), ("stuck", self.sensors.stuck)):
            for number in numbers:
                check_option(Parameter(name, 1, "", "", (1, self.nodes or 65_535)), number)
        if self.calibration and (self.mismatch or self.sensor == FSR):
            raise SpecError(
                "a calibration has curves of its own: leave out mismatch and sensor=fsr"
            )
        if self.worn is not None:
            self._check_worn(self.worn)
        self.setup()

    @classmethod
    def from_url(cls, url: str, worn: Layout | None = None) -> Self:
        """Read sim://?option=value&…; raises SpecError, also for what contradicts `worn`."""
        parts = urlsplit(url)
        if parts.scheme != SCHEME or parts.netloc or parts.path.strip("/") or parts.fragment:
            raise SpecError(f"{url!r} is not of the form sim://?option=value&option=value")
        return cls(**parse_options(parts.query, OPTIONS, "the simulator"), worn=worn)

    @property
    def stepped(self) -> bool:
        """Tell whether a frame begins only when the program that presses asks for it."""
        return self.scene == EXTERNAL and self.speed == 0

    @property
    def channel(self) -> Channel:
        return Channel(
            offset_v=self.offset,
            noise_rms_v=self.noise,
            stretch=self.stretch,
            jitter=self.jitter,
            rail_v=self.rail,
            adc_bits=self.adc_bits,
        )

    def clocks(self, nodes: int) -> NodeClocks | None:
        """Return the nodes' own clocks; None where all share one."""
        if not (self.clock_spread or self.delay_spread):
            return None
        rng = np.random.default_rng([self.seed, nodes])
        delay = rng.uniform(0, self.delay_spread, nodes)
        return NodeClocks(delay, rng.uniform(-self.clock_spread, self.clock_spread, nodes))

    @property
    def sensors(self) -> SensorModel:
        """Return the sensors of the skin; its `curves` are the true ones."""
        file = self.calibration and str(user_path("calibration", self.calibration))
        return SensorModel(
            kind=self.sensor,
            hysteresis=self.hysteresis,
            mismatch=self.mismatch,
            warming_v=self.warming * 1e-3,
            noise_v=self.sensor_noise,
            dead=_numbers("dead", self.dead),
            dead_after_s=self.dead_after,
            stuck=_numbers("stuck", self.stuck),
            seed=self.seed,
            calibration=file,
        )

    def rules(self, spec: FrameSpec) -> NodeRules:
        heartbeat = self.heartbeat
        if heartbeat == BY_THE_SECOND:
            heartbeat = usual_heartbeat(spec.frame_period_s)
        follow = usual_follow(spec, None if self.speaks == USUAL else self.speaks)
        return NodeRules(self.threshold, heartbeat, follow)

    def skin(self, nodes: int, first_row: int = FrameSpec.first_row) -> SkinGeometry:
        """Place the taxels; raises SpecError where layout, or rows and columns, do not fit."""
        if self.worn is not None and self.worn.wired == nodes:
            layout = self.worn
        elif self.layout:
            layout = self._read_layout(nodes, first_row)
        else:
            pitch = pitch_of(self.pitch_mm or DEFAULTS["pitch_mm"])
            size = self.rows or 0, self.columns or 0, pitch
            layout = Layout.grid(nodes, *size, min(across_and_down(pitch)))
        return SkinGeometry.of(layout, nodes, self.seed)

    def _check_worn(self, worn: Layout) -> None:
        """Raises SpecError where the options describe another skin than the driver's."""
        if self.nodes not in (None, worn.wired):
            return  # the driver will see that, and tell of it
        if self.layout:
            first_row = self._pinned_fields().get("first_row", FrameSpec.first_row)
            if not self._read_layout(worn.wired, first_row).is_alike(worn):
                raise SpecError(
                    f"layout {self.layout} is another skin than the driver's, {worn.name}: leave "
                    "it out, and the driver's is pressed"
                )
        for name, theirs in worn.said().items():
            ours = getattr(self, name)
            if ours not in (None, 0) and not is_same(ours, theirs):
                raise SpecError(
                    f"option {name} is {shown_mm(ours)}, but {shown_mm(theirs)} of the driver's "
                    f"skin, {worn.name}: leave it out, and the driver's is pressed"
                )

    def _read_layout(self, nodes: int | None, first_row: int) -> Layout:
        if self.rows or self.columns:
            raise SpecError("options rows and columns say what layout says: leave them out")
        return read_layout(user_path("layout", self.layout), Wiring(nodes, first_row))

    def setup(self, asked: Setup | None = None) -> Setup:
        """Set up the digitizer as a host asks for; None: before any CONFIGURE.

        Pinned options win. Where they leave too few code rows or too short a frame period, these
        grow, unless pinned themselves, so that INFO can show the host what contradicts it.
        Raises SpecError where the result cannot work.
        """
        pins = self._pinned_fields()
        if asked is None and self.layout:
            first_row = pins.get("first_row", FrameSpec.first_row)
            pins = {"nodes": self._read_layout(pins.get("nodes"), first_row).wired} | pins
        asked = asked or Setup()
        spec = replace(asked.spec, amplitude_v=self.amplitude_mv * 1e-3)
        if pins:
            spec = replace(spec, **self._room(spec, pins), **pins)
        if self._longest_s(spec) > spec.frame_period_s:
            raise SpecError(
                f"a frame of {spec.frame_s * 1e3:g} ms stretched by {self.stretch:g} and by slow "
                f"clocks of nodes is longer than its period of {spec.frame_period_s * 1e3:g} ms"
            )
        self.skin(spec.nodes, spec.first_row)
        sync, integrated = asked.sync, asked.integrated
        if self.timing is not None:
            sync = SyncMode.NONE if self.timing == GAP else SyncMode.DRIVE
            integrated = integrated and sync != SyncMode.NONE
        if self.integrated is not None:
            integrated = self.integrated
            if integrated and self.timing is None:
                sync = SyncMode.DRIVE
        if self.stepped and (sync == SyncMode.NONE or self.start_phase):
            raise SpecError(
                f"scene={EXTERNAL} with speed=0 goes from frame to frame, so these need marks, and "
                "the first one has to be whole: leave out timing=gap and start_phase, or set speed"
            )
        samples_per_chip = self.samples_per_chip or asked.samples_per_chip
        self._check_size(spec, samples_per_chip)
        wire = SyncWire[self.sync_wire.upper()] if self.sync_wire else asked.wire
        return Setup(spec, samples_per_chip, sync, integrated, asked.quiet_uv, wire)

    def _check_size(self, spec: FrameSpec, samples_per_chip: int) -> None:
        """Raises SpecError for frames that would take too long, or too much memory, to make."""
        samples = round(spec.frame_period_s / spec.chip_s * samples_per_chip)
        if samples > MOST_SAMPLES:
            raise SpecError(
                f"a frame period of {samples} samples is more than the simulator makes, "
                f"{MOST_SAMPLES}: lower samples_per_chip or frame_period_ms, or raise chip_us"
            )
        node_chips = spec.nodes * spec.span_chips if self.clocks(1) else 0
        if node_chips > MOST_NODE_CHIPS:
            raise SpecError(
                f"{spec.nodes} nodes with clocks of their own, {spec.span_chips} chips each, are "
                f"more than the simulator makes, {MOST_NODE_CHIPS} chips in all: lower nodes, or "
                "leave out clock_spread and delay_spread"
            )

    def _longest_s(self, spec: FrameSpec) -> float:
        """Return the longest that a frame of the slowest node takes, s."""
        slow = 1 + self.stretch + self.clock_spread
        return spec.frame_s * slow + self.delay_spread * spec.chip_s

    def _pinned_fields(self) -> dict[str, Any]:
        """Return the fields of FrameSpec that these options pin."""
        pins: dict[str, Any] = {name: getattr(self, name) for name in FRAME_PARAMETERS}
        # The wire carries whole ns and µs.
        if self.chip_us is not None:
            pins["chip_s"] = round(self.chip_us * 1e3) / 10**9
        if self.frame_period_ms is not None:
            pins["frame_period_s"] = round(self.frame_period_ms * 1e3) / 10**6
        pins = {name: value for name, value in pins.items() if value is not None}
        if self.sign_seed is not None:
            pins["sign_seed"] = None if self.sign_seed == NATURAL_SIGNS else self.sign_seed
        return pins

    def _room(self, spec: FrameSpec, pins: dict[str, Any]) -> dict[str, Any]:
        """Order and frame period, where not pinned, that are large enough for the pinned rest."""

        def wanted(name: str) -> Any:
            return pins.get(name, getattr(spec, name))

        rows = wanted("nodes") + wanted("first_row")
        order = wanted("order")
        if wanted("codes") != SPARSE and (not order or ("order" not in pins and order < rows)):
            order = default_order(rows)
        free = replace(spec, **{**pins, "order": order, "frame_period_s": math.inf})
        period_s = spec.frame_period_s
        if self._longest_s(free) > period_s:  # then the paper's ratio of period to frame
            period_s = math.ceil(1.6e6 * free.frame_s) / 10**6
        room = {"order": order, "frame_period_s": period_s}
        return {name: value for name, value in room.items() if name not in pins}


OPTIONS = tuple(
    # Others pin one of the driver's parameters; None leaves it to the host.
    Parameter(option.name, *option.metadata["about"]) if option.metadata else BY_NAME[option.name]
    for option in fields(SimOptions)
    if option.name != "worn"
)
"""Every option of a sim:// URL: name, meaning, unit, limits."""


def _numbers(name: str, text: str) -> tuple[int, ...]:
    """Read node numbers, from 1 on, from a list with commas."""
    try:
        return tuple(int(part) for part in text.split(",")) if text else ()
    except ValueError:
        raise SpecError(
            f"option {name} is {text!r}; it must be numbers of nodes with commas between: 3,17"
        ) from None
