# SPDX-License-Identifier: Apache-2.0

"""SkinBatch: what the drivers of many equal skins would publish, computed without the line.

On a line without faults the driver hears every word that a node sends. So all between the nodes'
words and the driver's is left out; what is before it, sensors, converters and the rule by which
nodes speak, is computed as in the simulator, and what is after it is looked up in a table of all
codes, which the driver's own Taxels has filled. test_sim_batch.py compares both ways code by code.

Every function of arrays is one of the array API standard, so that numpy, torch and JAX do, on any
device; nothing depends on values, so that it can be compiled (jax.jit, torch.compile).
"""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np

from ...base.arrays import Floats32, Uint8s
from ...base.errors import ParameterError, SpecError
from ...config.python_arguments import argument, instance, unmasked
from ...config.skin_config import SkinConfig
from ...driver.checkup import OTHER_SENSORS
from ...readings.baseline import Baseline
from ...readings.calibration import Curves
from ...readings.drift import DriftTracker, nodes_beside
from ...readings.pressure import PressureChain
from ...readings.taxels import Taxels
from ...wire._protocol import TAIL_CHIPS
from ...words.health import NodeHealth
from ...words.words import silent
from ..nodes import NodeRules, rest_codes
from ..options import Setup, SimOptions
from ..scene import EXTERNAL
from ..sensor import Dynamics, followed
from .standard import Array, array_api, described, floating, is_array

PUBLISHING_S = 1e-3
"""From a frame's last sample to a subscriber, s: more than the median of make bench-ros."""
MOST_READINGS = 1 << 26
"""Codes × taxels of the table. Chosen: 0.6 GB; words of 16 bits of 1,024 taxels."""
MOST_ENVS, MOST_DELAY_FRAMES = 1 << 31, 1 << 16
"""Chosen, far above what memory holds."""
LEFT_OUT = (
    *("scene", "noise", "offset", "stretch", "jitter", "clock_spread", "delay_spread", "rail"),
    *("adc_bits", "warming"),
)
"""Options of the simulator that say what a batch leaves out: line, digitizer, scene and drift."""
_log = logging.getLogger(__name__)
_NEVER = -(1 << 30)
"""Number of the frame in which a node spoke that was never heard."""


class BatchFrame(NamedTuple):
    """One frame of e skins of t taxels, as the driver's; arrays of the kind that was given.

    pressure_pa: (e, t) float32, Pa, NaN without a valid reading. status: (e, t) uint8, bits of
    Status. active: (e, t) bool, whose nodes spoke. codes: (e, t) integers, their last words.
    """

    pressure_pa: Array
    status: Array
    active: Array
    codes: Array


class Skins(NamedTuple):
    """What sensors and nodes of s skins are like, s = 1 where all are alike, else e.

    (s, t): rest, code of the untouched sensor; beat, as NodeRules.beat; dies, the frame from which
    the node is dead; is_stuck; rest_v, V; pieces: start, end and width, Pa, and rise, V, of the
    pieces of the sensor's curve; tare_pa, what is taken off. (s, 1): lsb_v, V; noise_v, rms, V;
    threshold, LSB; heartbeat, follow, frames; rise, fall: shares of a change that pass the lag in a
    frame; widths, weights: of the plays, as in Dynamics.
    """

    rest: Array
    beat: Array
    dies: Array
    is_stuck: Array
    rest_v: Array
    pieces: tuple[tuple[Array, Array, Array, Array], ...]
    tare_pa: Array
    lsb_v: Array
    noise_v: Array
    threshold: Array
    heartbeat: Array
    follow: Array
    rise: Array
    fall: Array
    widths: tuple[Array, ...]
    weights: tuple[Array, ...]


class BatchState(NamedTuple):
    """Holds what e skins remember from frame to frame; a tuple, which JAX can pass through jit.

    number: (e, 1) integers, frames since the start. rest: (e, t) integers, the nodes' codes at
    rest. codes: (e, t) integers, sent last. heard: (e, t) integers, the frame in which that was.
    lagged_pa: (e, t), Pa, behind the lag. plays: each (e, t), of the hysteresis. late: frames that
    are not published yet, the oldest first. skins: what sensors and nodes are like.
    """

    number: Array
    rest: Array
    codes: Array
    heard: Array
    lagged_pa: Array
    plays: tuple[Array, ...]
    late: tuple[BatchFrame, ...]
    skins: Skins


class SkinBatch:
    """Simulates a skin in each environment, each with an equal driver, without the line.

    docs/simulation.md has an example.

    config: of the driver. envs: number of skins. simulator: sim:// URL, or one for each
    environment, whose options say what its sensors and nodes are like: sensor, hysteresis,
    calibration, mismatch, sensor_noise, dead, dead_after, stuck, threshold, heartbeat, start_phase,
    seed; those in LEFT_OUT are refused. delay_frames: steps by which frames come late; None: as
    many as pass from measuring to publishing, 0: as Skin.step, for which the world waits. tared:
    the drivers were tared while nothing touched the skins.

    What a driver does about drift is left out, and so is all that the line, the transport and the
    computer may do wrong. Raises ParameterError, or SpecError for options that do not fit.
    """

    def __init__(
        self,
        config: SkinConfig,
        envs: int,
        simulator: str | Sequence[str] = "sim://",
        delay_frames: int | None = None,
        tared: bool = False,
    ) -> None:
        array_api()  # where it is missing this is told first
        spec = instance("config", config, SkinConfig).spec
        urls = [argument("simulator", simulator, "")] if isinstance(simulator, str) else simulator
        self.envs: int = argument("envs", envs, 1, (1, MOST_ENVS))
        if not isinstance(urls, list | tuple) or len(urls) not in {1, envs}:
            raise ParameterError(f"simulator is no URL, and no list of {envs}, one for each skin")
        options = [SimOptions.from_url(argument("simulator", u, ""), config.layout) for u in urls]
        for each in options:
            _check(config, each)
        sensors = [each.sensors for each in options]
        if not all(s.is_read_by(config.calibration, config.curve, config.adc) for s in sensors):
            _log.warning("%s", OTHER_SENSORS)
        # From the moment when the nodes measure until the frame is published.
        delay_s = spec.frame_s + TAIL_CHIPS * spec.chip_s + PUBLISHING_S
        least = math.ceil(delay_s / spec.frame_period_s)
        late = least if delay_frames is None else delay_frames
        self.delay_frames: int = argument("delay_frames", late, 0, (0, MOST_DELAY_FRAMES))
        self.config, self.taxels = config, len(config.layout)
        self._noise_v = max(each.noise_v for each in sensors)
        self._stale_frames = math.floor(config.stale_after_s / spec.frame_period_s + 1e-6)
        self._tables = _Tables.of(config, options, argument("tared", tared, False))
        self._plays = len(self._tables.skins.widths)
        self._here = self._tables  # from begin on as arrays of the kind that it was given
        self._xp: Any = None
        self._kind: type | None = None  # of these arrays; another one may be of the same library

    def begin(self, like: Array, heard: bool = True) -> BatchState:
        """The state of untouched skins, and from now on arrays of like's kind, device and type.

        like: any array of float32 or float64; float64 gives the codes of the simulator, float32
        a few in 10⁵ that differ by one. heard: every node has been heard before, as a second after
        a driver's start. Not to be called inside of jit.
        """
        argument("heard", heard, False)
        xp = self._xp = floating("like", like)
        here, self._kind = self._tables.moved(xp, like), type(like)
        self._here = here
        shape = self.envs, self.taxels
        nothing_pa = xp.zeros(shape, dtype=like.dtype, device=array_api().device(like))
        codes = xp.zeros_like(nothing_pa, dtype=here.skins.rest.dtype) + here.skins.rest
        number = xp.zeros_like(codes[:, :1])
        never = xp.full_like(codes, _NEVER)
        since = never
        if heard:
            since = xp.where(here.skins.dies <= 0, never, xp.full_like(codes, -1))
        plays, words = (nothing_pa,) * self._plays, (codes, codes != codes, since)
        late = (self._published(here.skins, number, *words),) * self.delay_frames
        return BatchState(number, codes, codes, since, nothing_pa, plays, late, here.skins)

    def step(
        self, state: BatchState, pressure_pa: Array, deviates: Array | None = None
    ) -> tuple[BatchState, BatchFrame]:
        """One frame later: the state, and the frame that is published by then.

        pressure_pa: (e, t), Pa, on every taxel when the nodes measure. deviates: (e, t), standard
        normal, for sensor_noise; drawn by the caller, as each library does that its own way. Where
        one is not finite the node is dead in this frame.
        """
        self._check_state("state", state)
        xp, here, skins = self._xp, self._here, state.skins
        self._check_array("pressure_pa", pressure_pa)
        is_known = xp.isfinite(pressure_pa)
        if deviates is not None:
            self._check_array("deviates", deviates)
            is_known = is_known & xp.isfinite(deviates)
            deviates = xp.where(is_known, deviates, here.zero)
        is_dead = ~is_known | (skins.dies <= state.number)
        pressure_pa = xp.where(is_known & (pressure_pa > 0), pressure_pa, here.zero)
        lagged_pa, plays = state.lagged_pa, state.plays
        if plays:
            missing_pa = pressure_pa - lagged_pa
            passed = xp.where(missing_pa > 0, skins.rise, skins.fall)
            lagged_pa = xp.where(passed < 1, lagged_pa + passed * missing_pa, pressure_pa)
            dynamics = Dynamics(0.0, 0.0, skins.widths, skins.weights)
            plays, felt_pa = followed(plays, lagged_pa, dynamics, xp)
            pressure_pa = xp.where(skins.rise < 1, felt_pa, pressure_pa)
        measured = self._measured(skins, pressure_pa, deviates)
        rules = NodeRules(skins.threshold, skins.heartbeat, skins.follow)
        active = rules.has_news(measured, state.rest, state.codes)
        turn = state.number % xp.maximum(skins.heartbeat, xp.ones_like(skins.heartbeat))
        active = active | ((skins.heartbeat > 0) & (skins.beat == turn))
        active = active & ~is_dead
        codes = xp.where(active, measured, state.codes)
        heard = xp.where(active, state.number, state.heard)
        late = (*state.late, self._published(skins, state.number, codes, active, heard))
        number, rest = state.number + 1, rules.followed(state.number, measured, state.rest, xp)
        return BatchState(number, rest, codes, heard, lagged_pa, plays, late[1:], skins), late[0]

    def reset(self, state: BatchState, fresh: BatchState, done: Array) -> BatchState:
        """The state with the skins that are done, (e,) bool, as in `fresh`, which begin gave.

        fresh: perhaps of another batch with other URLs, one for each environment, as this one's:
        sensors and nodes are drawn anew so.
        """
        self._check_state("state", state)
        self._check_state("fresh", fresh)
        fits = is_array(unmasked("done", done), (self.envs,))
        if not (fits and self._xp.isdtype(done.dtype, "bool")):
            raise ParameterError(f"done is {described(done)}; it must be ({self.envs},) of bool")
        where, done = self._xp.where, done[:, None]

        def chosen(old: Array, new: Array) -> Array:
            return where(done, new, old) if old.shape[0] == self.envs else old

        mixed: BatchState = _mapped(chosen, state, fresh)
        return mixed

    def _measured(self, skins: Skins, pressure_pa: Array, deviates: Array | None) -> Array:
        """Convert pressures to what the converters read, (e, t) integers."""
        xp, here = self._xp, self._here
        voltage_v = skins.rest_v
        for low_pa, high_pa, width_pa, rise_v in skins.pieces:
            within_pa = xp.minimum(xp.maximum(pressure_pa, low_pa), high_pa)
            voltage_v = voltage_v + (within_pa - low_pa) / width_pa * rise_v
        if self._noise_v:
            if deviates is None:
                raise ParameterError(f"sensor_noise is {self._noise_v:g} V: give `deviates`, too")
            voltage_v = voltage_v + skins.noise_v * deviates
        counts = xp.maximum(xp.floor(voltage_v / skins.lsb_v + 0.5), here.zero)
        codes = xp.astype(xp.minimum(counts, here.last), skins.rest.dtype)
        return xp.where(skins.is_stuck, skins.rest, codes)

    def _published(
        self, skins: Skins, number: Array, codes: Array, active: Array, heard: Array
    ) -> BatchFrame:
        """Look up what Taxels makes of these words."""
        xp, here = self._xp, self._here
        place = xp.reshape(codes * self.taxels + here.column, (-1,))
        stale = number - heard > self._stale_frames
        pressure_pa = xp.reshape(xp.take(here.pressure_pa, place), codes.shape) - skins.tare_pa
        status = xp.reshape(xp.take(here.status, place), codes.shape)
        status = xp.where(active, status, status | here.silent)
        return BatchFrame(
            xp.where(stale, here.nan, pressure_pa),
            xp.where(stale, here.unheard, status),
            active,
            codes,
        )

    def _check_array(self, name: str, array: Array) -> None:
        """Raises ParameterError unless it is one of those that begin prepared for."""
        shape, kind = (self.envs, self.taxels), self._here.zero.dtype
        same = is_array(unmasked(name, array), shape) and (
            type(array) is self._kind or array_api().array_namespace(array) is self._xp
        )
        if not same or array.dtype != kind:
            raise ParameterError(
                f"{name} is {described(array)}; as in begin() it must be {shape} of {kind}, of the "
                "same library"
            )

    def _check_state(self, name: str, state: BatchState) -> None:
        """Raises ParameterError unless it is one of this batch's, as it was begun last."""
        if self._kind is None:
            raise ParameterError("call SkinBatch.begin first: it takes the kind of the arrays")
        instance(name, state, BatchState)
        self._check_array(f"{name}.lagged_pa", state.lagged_pa)
        if len(state.late) != self.delay_frames:
            raise ParameterError(
                f"{name} is {len(state.late)} frames late; this batch is {self.delay_frames}"
            )


class _Tables(NamedTuple):
    """Holds what the driver makes of words, for every taxel, (t,), and the skins as they begin.

    last: the highest code. column: the taxel's index. pressure_pa, status: (codes · t,) of the
    taxels whose nodes spoke. silent: bits besides where they did not; unheard: status of those
    unheard for too long. zero, nan: of the pressures' types.
    """

    skins: Skins
    last: Array
    column: Array
    pressure_pa: Array
    status: Array
    silent: Array
    unheard: Array
    zero: Array
    nan: Array

    @classmethod
    def of(cls, config: SkinConfig, options: Sequence[SimOptions], tared: bool) -> Self:
        pressure_pa, status, silent_bits, unheard = _readings(config)
        curves = [each.sensors.curves(config.spec.nodes) for each in options]
        corners, plays = max(len(each.pressure_pa) for each in curves), 0
        for model in (each.sensors.dynamics for each in options):
            plays = max(plays, len(model.widths) if model else 0)
        skins = [_skin(config, *one, corners, plays) for one in zip(options, curves, strict=True)]
        taxels = np.arange(len(config.layout))
        if tared:
            skins = [skin._replace(tare_pa=pressure_pa[skin.rest, taxels]) for skin in skins]
        return cls(
            _mapped(lambda *values: np.stack([*map(np.atleast_1d, values)]), *skins),
            np.asarray(float((1 << config.spec.bits) - 1)), taxels,
            pressure_pa.ravel(), status.ravel(), silent_bits, unheard,
            np.zeros(()), np.full((), np.nan, np.float32),
        )  # fmt: skip

    def moved(self, xp: Any, like: Array) -> Self:
        """Move the arrays to the kind and device of `like`, whose type the floating ones take."""
        where = array_api().device(like)
        kinds = {"i": xp.arange(1).dtype, "f": like.dtype}

        def move(array: Any) -> Array:
            kind = {"float32": xp.float32, "uint8": xp.uint8, "bool": xp.bool}.get(array.dtype.name)
            return xp.asarray(array, dtype=kind or kinds[array.dtype.kind], device=where)

        moved: Self = _mapped(move, self)
        return moved


def _mapped(function: Callable[..., Any], *trees: Any) -> Any:
    """Apply a function to the arrays of trees that are alike, made of tuples and of named ones."""
    first = trees[0]
    if not isinstance(first, tuple):
        return function(*trees)
    parts = [_mapped(function, *each) for each in zip(*trees, strict=True)]
    return type(first)(*parts) if hasattr(first, "_fields") else tuple(parts)


def _skin(
    config: SkinConfig, options: SimOptions, curves: Curves, corners: int, plays: int
) -> Skins:
    """Describe one skin, without the first axis.

    corners, plays: how many there have to be; those that are added change nothing.
    """
    spec, sensors, rules = config.spec, options.sensors, options.rules(config.spec)
    node = np.maximum(config.layout.nodes - 1, 0)  # of what has none nothing is seen
    adc, lags = sensors.adc(spec.bits), sensors.dynamics
    low_pa, low_v = curves.pressure_pa[:, node], curves.voltage_v[:, node]
    more = ((0, corners - len(low_pa)), (0, 0))
    low_pa, low_v = (np.pad(each, more, "edge") for each in (low_pa, low_v))
    widths_pa, rises_v = np.diff(low_pa, axis=0), np.diff(low_v, axis=0)
    widths_pa[widths_pa == 0] = 1.0
    dies = np.full(spec.nodes, 1 << 30)
    first = math.ceil(sensors.dead_after_s / spec.frame_period_s + options.start_phase - 1e-9)
    dies[sensors.indices(sensors.dead, spec.nodes)] = first
    is_stuck = np.zeros(spec.nodes, bool)
    is_stuck[sensors.indices(sensors.stuck, spec.nodes)] = True
    lag_s = (lags.rise_s, lags.fall_s) if lags else (0.0, 0.0)
    rise, fall = (-math.expm1(-spec.frame_period_s / s) if s else 1.0 for s in lag_s)
    return Skins(
        rest=rest_codes(sensors, adc, spec.nodes)[node],
        beat=rules.beat(spec.nodes)[node],
        dies=dies[node],
        is_stuck=is_stuck[node],
        rest_v=low_v[0],
        pieces=tuple(zip(low_pa[:-1], low_pa[1:], widths_pa, rises_v, strict=True)),
        tare_pa=np.zeros(len(node), np.float32),
        lsb_v=adc.lsb_v,
        noise_v=sensors.noise_v,
        threshold=rules.threshold,
        heartbeat=rules.heartbeat,
        follow=rules.follow,
        rise=rise,
        fall=fall,
        widths=lags.widths if lags else (0.0,) * plays,
        weights=lags.weights if lags else (0.0,) * plays,
    )


def _check(config: SkinConfig, options: SimOptions) -> None:
    """Raises SpecError for what is not modelled, or for a simulator of another skin."""
    spec, readings = config.spec, len(config.layout) << config.spec.bits
    theirs = options.setup(Setup(spec)).spec
    for name in ("nodes", "bits", "frame_period_s"):
        mine, its = getattr(spec, name), getattr(theirs, name)
        if mine != its:
            raise SpecError(f"{name} is {mine}, but {its} in the options of the simulator")
    if spec.sparse:
        raise SpecError(
            "SkinBatch has orthogonal codes only: how many nodes may speak at once is not modelled"
        )
    for name in LEFT_OUT:
        value, usual = getattr(options, name), getattr(SimOptions, name)
        if value not in (usual, 0, EXTERNAL):
            raise SpecError(f"SkinBatch does not model {name}={value}: leave that out")
    if readings > MOST_READINGS:
        raise SpecError(
            f"{len(config.layout)} taxels of {spec.bits} bits have {readings} readings; the table "
            f"holds {MOST_READINGS}: lower bits or nodes"
        )


def _readings(config: SkinConfig) -> tuple[Floats32, Uint8s, Uint8s, Uint8s]:
    """Have a driver's own code tell what it publishes of every code, and of silence.

    Returns pressures, Pa, and status of every code, (codes, t) each; (t,) the bits that silence
    adds, and (t,) the status of taxels whose nodes were unheard for too long.
    """
    spec, layout = config.spec, config.layout
    tracker = DriftTracker(config.adc, nodes_beside(layout, spec.nodes), config.rest)
    chain = PressureChain(config.calibration, Baseline(spec.nodes), tracker)
    taxels = Taxels(spec.nodes, config.adc, chain, layout, config.stale_after_s)
    nobody, health = silent(spec.nodes, 0.0), NodeHealth(spec)
    unheard = taxels.update(nobody, 0.0, health).status
    everybody, codes = np.ones(spec.nodes, np.bool_), np.arange(1 << spec.bits, dtype=np.int32)
    said = (replace(nobody, active=everybody, codes=np.full(spec.nodes, code)) for code in codes)
    read = [taxels.update(words, 0.0, health) for words in said]
    pressure_pa = np.stack([each.pressure_pa for each in read])
    status = np.stack([each.status for each in read])
    held = taxels.update(nobody, 0.0, health).status
    return pressure_pa, status, held & ~status[-1], unheard
