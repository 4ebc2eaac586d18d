# SPDX-License-Identifier: Apache-2.0

"""The current reading of every taxel: silent nodes hold their last value, unheard ones go stale."""

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from operator import is_not
from typing import Self

import numpy as np

from ..base import kernel
from ..base.arrays import Bools, Floats32, Uint8s
from ..base.stage import stage
from ..framing.frames import words_memory, words_of
from ..places.layout import Layout
from ..words.health import WEAK_RHO, NodeHealth, NodeState
from ..words.limits import LIMITS
from ..words.words import Words
from .baseline import LOOK_S, Baseline, take_tare
from .calibration import AdcScale, Calibration
from .pressure import PressureChain, Uncertainty
from .status import Status, is_certain, is_in_service


@dataclass(frozen=True, slots=True)
class Coverage:
    """How much of a patch is read.

    valid: taxels with a valid, certain reading. in_service: taxels with a node that are not masked,
    nor out of service by dead_share. doubtful: valid ones whose zero is none: they read below it by
    as much as a contact is above, or none at the end of the range.
    """

    valid: int = 0
    in_service: int = 0
    doubtful: int = 0

    @classmethod
    def of(cls, pressure_pa: Floats32, status: Uint8s, contact_pa: float = math.inf) -> Self:
        """That of one frame; pressure_pa: (t,), Pa, NaN without a reading; status: (t,) bits.

        contact_pa: pressure from which on there is a contact, Pa.
        """
        in_service = is_in_service(status)
        valid = in_service & is_certain(status) & np.isfinite(pressure_pa)
        doubtful = (status & _SATURATED != 0) & (pressure_pa <= contact_pa)
        doubtful = valid & (doubtful | (pressure_pa < -contact_pa))
        return cls(*(int(np.count_nonzero(some)) for some in (valid, in_service, doubtful)))

    @property
    def is_whole(self) -> bool:
        """Whether every taxel in service has a certain reading."""
        return self.valid == self.in_service > 0

    @property
    def is_certain(self) -> bool:
        """Whether all of these mean what they say: only then nothing found is no touch."""
        return self.is_whole and not self.doubtful

    @property
    def is_most(self) -> bool:
        """Whether at least half of the taxels in service have a certain reading.

        With fewer, more of the skin is blind than seen: an equal load there would more than double
        every sum over the patch, and move its centre to taxels that were not read.
        """
        return 2 * self.valid >= self.in_service > 0


@stage
class Readings:
    """The readings of one frame, taxel by taxel in the order of the layout.

    pressure_pa (Pa), voltage_v (V): (t,) float32, NaN where there is no valid reading.
    status: (t,) uint8, bits of Status. sigma_pa: (t,) float32, how sure pressures are, 1 σ, Pa: NaN
        where that is unknown, infinite beyond the range; None unless it is asked for.
    Treat the arrays as read-only: frames without new words share them.
    """

    pressure_pa: Floats32
    voltage_v: Floats32
    status: Uint8s
    sigma_pa: Floats32 | None = None

    @property
    def certain_voltage_v(self) -> Floats32:
        """Voltages (n,), V; NaN where the reading is in doubt or held from before a loss."""
        return np.where(is_certain(self.status), self.voltage_v, np.float32(np.nan))

    def coverage(self, contact_pa: float) -> Coverage:
        return Coverage.of(self.pressure_pa, self.status, contact_pa)


_BITS = "silent", "low_snr", "stale", "saturated", "uncalibrated", "masked", "faulty"
"""Flags of Status that the kernel sets."""
_OF_WORDS = "active", "doubtful", "doubled", "odd", "faint", "codes", "amplitude_v", "rho", "margin"
"""Fields of Words that the kernel reads."""


class Readout(kernel.Held):
    """The kernel's readout (kernel/readout.h): words of a frame → readings of t taxels, in a call.

    Of the last frame, until the next one: readings: twice (t,) float32, pressure, Pa, and voltage,
    V, and status: (t,) uint8; rest: twice (n,) float32, V and Pa, and valid: (n,) bool, for tare
    and drift (see Baseline.look).
    """

    def __init__(self, taxels: "Taxels", health: NodeHealth) -> None:
        """Take verdicts and calibration as they are now."""
        chain, table_v, source = taxels.chain, taxels._voltage_of, taxels._source
        curves, nodes, pointer = chain.calibration.curves, len(taxels._codes), kernel.pointer
        count = len(source) or nodes
        self.rest = np.empty(nodes, np.float32), np.empty(nodes, np.float32)
        self.valid = np.empty(nodes, np.bool_)
        settings = kernel.struct(
            "readout_settings",
            **{bit: Status[bit.upper()] for bit in _BITS},
            nodes=nodes,
            codes=len(table_v),
            pieces=len(curves.pieces),
            taxels=count,
            low_rho=LIMITS.low_rho,
            low_margin=LIMITS.low_margin,
            weak=health.weak_v,
            weak_rho=WEAK_RHO,
        )
        by_node = {
            "state": _FLAGS_OF[health.state],
            "invalid": health.invalid,
            "uncalibrated": chain.calibration.uncalibrated,
            "masked": taxels._masked,
            **chain.bounds._asdict(),
            "kept_codes": taxels._codes,
            "kept_flags": taxels._flags,
            "heard_s": taxels._heard_s,
        }
        skin = kernel.struct(
            "readout_skin",
            **{name: pointer(values, nodes) for name, values in by_node.items()},
            table_v=pointer(table_v, len(table_v)),
            pieces=pointer(curves.pieces, len(curves.pieces), 3, nodes),
            source=pointer(source, len(source)) if len(source) else kernel.ffi.NULL,
            sums=pointer(health.sums, *health.sums.shape),
        )
        made = kernel.lib.readout_new(settings.at, skin.at)
        super().__init__(made, kernel.lib.readout_free, settings, skin)
        self._memory, self._nodes = words_memory(nodes), nodes
        given = words_of(self._memory, nodes, 0.0)
        self._given = [(name, getattr(given, name)) for name in _OF_WORDS]
        where = pointer(self._memory, self._memory.size)
        self._words = kernel.ffi.new("struct words *", kernel.lib.words_in(where, nodes))
        self.readings = np.empty(count, np.float32), np.empty(count, np.float32)
        self.status = np.empty(count, np.uint8)
        self._frame = kernel.struct(
            "readout_frame",
            pressure_pa=self.readings[0],
            voltage_v=self.readings[1],
            status=self.status,
            node_v=self.rest[0],
            node_pa=self.rest[1],
            valid=self.valid,
        )
        self._chain = chain
        self._of_baseline: tuple[Floats32, Floats32] = (np.empty(0, np.float32),) * 2
        self._pointers: tuple[object, ...] = ()

    def read(self, words: Words | Uint8s, counts: bool, now_s: float, stale_after_s: float) -> None:
        """Read a frame.

        words: its words, or the memory in which the kernel wrote them. counts: they say something
        of their nodes. now_s: device time of the frame.
        """
        if isinstance(words, Words):
            for name, given in self._given:
                given[:] = getattr(words, name)
        else:
            self._memory[:] = words
        drift_v, tare_pa = self._chain.baseline.drift_v, self._chain.baseline.tare_pa
        if drift_v is not self._of_baseline[0] or tare_pa is not self._of_baseline[1]:
            self._of_baseline = drift_v, tare_pa
            self._pointers = tuple(kernel.pointer(one, self._nodes) for one in self._of_baseline)
        kernel.lib.readout_read(
            self.at, self._words, counts, now_s, stale_after_s, *self._pointers, self._frame.at
        )


class Taxels:
    """Keeps the last word of every node.

    A silent node has not changed by more than its own threshold, so its last value stands (flag
    SILENT), as long as no frame was lost in which it may have said another one: then it is UNHEARD
    until it speaks again, be it at its heartbeat. A node that was not heard for stale_after_s, or
    never, reads NaN (flag STALE), as does one whose words contradict the code (flag FAULTY).
    Masked nodes and taxels without a node have no reading (flag MASKED). Taxels that had one of
    these two flags for stale_after_s are MASKED as well, unless there are more than dead_share.

    stale_after_s: silence after which a node is stale, s. dead_share: of the taxels in service.
    with_sigma: whether to tell how sure readings are. Call refresh() after changing one of these.
    now_s: device time of the last frame, s. masks: numbers of the nodes that are masked, by who
    does it. retired: of those that are out of service as dead.
    """

    def __init__(
        self, nodes: int, adc: AdcScale, chain: PressureChain, layout: Layout, stale_after_s: float
    ) -> None:
        self.chain = chain
        self._layout = layout
        self._masked = np.zeros(nodes, dtype=bool)
        self.masks = {"layout": layout.masked}
        self.stale_after_s, self.dead_share = stale_after_s, 0.0
        self.retired: tuple[int, ...] = ()
        self.with_sigma = False
        self._uncertainty: Uncertainty | None = None
        self._named_s = np.full(len(layout), np.inf)  # since when a taxel has one of _DEAD
        self.mask()
        # A table of all codes is quicker than converting each word.
        self._voltage_of = adc.voltage(np.arange(1 << adc.bits)).astype(np.float32)
        self._lsb_v = adc.lsb_v
        # The kernel keeps each node's last word, its device time, s, and LOW_SNR where that is so.
        # Readout's kernel has pointers to these arrays, and to _masked: they must never be rebound,
        # only filled anew.
        self._heard_s = np.full(nodes, -np.inf)
        self._codes, self._flags = np.zeros(nodes, np.int32), np.zeros(nodes, np.uint8)
        self._doubted_s = np.full(nodes, -np.inf)  # last frame at which flags said so, device time
        self._told_flags = self._flags.tobytes()  # when they were last compared
        self._source = np.asarray([] if layout.source is None else layout.source, np.int32)
        self._readout: Readout | None = None
        self._read_by: tuple[object, ...] = ()  # what the readout is made for
        self._silence: Readings | None = None  # readings of silent frames, until a node transmits
        self._stale_from_s = -np.inf  # when the next node goes stale, device time
        self.now_s = 0.0
        self._began_s = np.inf  # the first frame's time

    def mask(self, **masks: Collection[int]) -> None:
        """Take these nodes out of service, in place of those that the same ones masked before."""
        self.masks |= {by: tuple(nodes) for by, nodes in masks.items()}
        self._masked[:] = False
        self._masked[[node - 1 for node in (*self.masked, *self._layout.unplaced)]] = True
        self.refresh()

    @property
    def masked(self) -> list[int]:
        """Numbers of the nodes that are masked, 1-based."""
        return sorted({node for nodes in self.masks.values() for node in nodes})

    @property
    def in_service(self) -> int:
        return int(np.count_nonzero(~self._masked))

    @property
    def missing(self) -> list[int]:
        """Numbers of the nodes in service that were not heard for stale_after_s, as of now_s."""
        return _numbers(self._is_missing)

    @property
    def dead(self) -> list[int]:
        """Missing nodes never heard since stream or clock began; none until stale_after_s."""
        if self.now_s - self._began_s <= self.stale_after_s:
            return []
        return _numbers(self._is_missing & np.isinf(self._heard_s))

    @property
    def stale(self) -> list[int]:
        """The missing nodes that were heard before."""
        return _numbers(self._is_missing & np.isfinite(self._heard_s))

    @property
    def unheard(self) -> list[int]:
        """Numbers of the nodes in service that are UNHEARD, as of now_s."""
        kept = self._heard_s >= self.now_s - self.stale_after_s
        silent = kept & (self._heard_s < self.now_s)
        return _numbers(silent & (self._flags != 0) & ~self._masked)

    def doubts_rise(self) -> bool:
        """Tell whether a value in service is in doubt that was not at the last call."""
        flags = self._flags.tobytes()
        if flags == self._told_flags:
            return False
        before, self._told_flags = np.frombuffer(self._told_flags, np.uint8), flags
        return bool(np.any((self._flags != 0) & (before == 0) & ~self._masked))

    @property
    def may_answer(self) -> bool:
        """Whether a node that is not missing yet has no certain value."""
        unsure = (self._flags != 0) | np.isinf(self._heard_s)
        heard_s = np.maximum(self._heard_s, self._began_s)
        return bool(np.any(unsure & ~self._masked & (self.now_s - heard_s <= self.stale_after_s)))

    @property
    def _is_missing(self) -> Bools:
        return np.asarray((self.now_s - self._heard_s > self.stale_after_s) & ~self._masked)

    def miss(self, nodes_repeat: bool, spoke: Bools) -> None:
        """Note that a frame was not heard, in which any node may have spoken.

        spoke: (n,), nodes that did in the last frame in which they might. nodes_repeat: they do so
        in every such frame while their code is farther than a threshold from that at rest, or from
        the one they sent last (firmware/core/event.c). Who was silent in the last one held a value
        within two thresholds of its rest then; if it is silent in the next one, too, its code is
        within one of it. So what it holds stands, but for three thresholds, and only who spoke may
        have told its release unheard.
        """
        self._flags[spoke if nodes_repeat else slice(None)] = Status.LOW_SNR
        self._silence = None

    def waiting(self, readings: Readings, nodes: Bools) -> Readings:
        """The readings of a frame in which these nodes, (n,), kept what they had to say.

        Their values are UNHEARD until their turn comes, and if they are silent then, hold.
        """
        source = self._layout.source
        waits = nodes if source is None else nodes[source] & (source >= 0)
        waits = waits & (readings.status & np.uint8(Status.STALE | Status.MASKED) == 0)
        status = readings.status | np.where(waits, np.uint8(Status.LOW_SNR), np.uint8(0))
        return replace(readings, status=status)

    def forget(self) -> None:
        """Start over: the device's clock was reset, and no node was heard on the new one."""
        self._heard_s[:], self._doubted_s[:], self._began_s = -np.inf, -np.inf, np.inf
        self._named_s[:], self._uncertainty = np.inf, None
        self._silence, self._stale_from_s = None, -np.inf
        self.chain.forget()

    @property
    def baseline(self) -> Baseline:
        return self.chain.baseline

    def tare(self, contact_pa: float, force: bool | str = False) -> list[int]:
        """Make the present readings the zero; see take_tare."""
        curves = self.chain.calibration.curves
        just_started = self.now_s - self._began_s <= self.stale_after_s
        may_speak = just_started & ~self._masked
        sure_s = np.where(self._flags, 0.0, self.now_s - self._doubted_s)
        unheard = take_tare(
            self.baseline, curves, self._layout, self._lsb_v, contact_pa, may_speak, sure_s, force
        )  # fmt: skip
        self.refresh()
        return [number for number in unheard if not self._masked[number - 1]]

    def restore(
        self,
        rest_v: Floats32 | None = None,
        drift_v: Floats32 | None = None,
        tared_drift_v: Floats32 | None = None,
        least_v: Floats32 | None = None,
    ) -> None:
        """Restore tare and drift, (n,) float32, V, each as in Baseline; None: no tare, no drift.

        Tares are the curves' pressures at rest_v and least_v.
        """
        self.baseline.clear()
        if rest_v is not None:
            curves, least_v = self.chain.calibration.curves, rest_v if least_v is None else least_v
            self.baseline.rest_v, self.baseline.least_v = rest_v, least_v
            self.baseline.tare_pa = curves.pressure(rest_v)
            self.baseline.least_pa = curves.pressure(least_v)
        if drift_v is not None:
            self.baseline.drift_v = drift_v
        if tared_drift_v is not None:
            self.baseline.tared_drift_v = tared_drift_v
        self.refresh()

    def calibrate(self, calibration: Calibration) -> None:
        """Use another calibration from now on; the tare is its curves' pressure at rest."""
        self.chain.calibration = calibration
        rest = self.baseline
        self.restore(rest.rest_v, rest.drift_v, rest.tared_drift_v, rest.least_v)

    def refresh(self) -> None:
        """Have the next frame read anew: something other than the words has changed."""
        self._silence = None
        self.chain.unsettle()

    def update(
        self, words: Words | Uint8s, t_device: float, health: NodeHealth, counts: bool = False
    ) -> Readings:
        """Update with one frame's words, see Readout.read; t_device: its device time, s.

        counts: what the words say of their nodes goes into their health.
        """
        chain, readout = self.chain, self._readout_of(health)
        if not _none(self._flags):
            np.copyto(self._doubted_s, self.now_s, where=self._flags != 0)
        readout.read(words, counts, t_device, self.stale_after_s)
        self.now_s, self._began_s = t_device, min(self._began_s, t_device)
        rest_v, rest_pa = readout.rest
        chain.moved = False
        if not 0 <= t_device - chain.looked_s < LOOK_S:  # before a call that few frames need
            chain.look(rest_v, rest_pa, readout.valid, t_device)
        (pressure_pa, voltage_v), status = readout.readings, self._judged(readout.status, t_device)
        self._silence = None
        sigma_pa = self._sigma_pa(rest_pa, pressure_pa, status) if self.with_sigma else None
        return Readings(pressure_pa.copy(), voltage_v.copy(), status, sigma_pa)

    def update_silent(self, words: Words, t_device: float, health: NodeHealth) -> Readings:
        """Update with the words of a frame in which nobody spoke; see `update`.

        The readings are those of the last such frame, where an update would give them.
        """
        held = self._silence if t_device <= self._stale_from_s else None
        if held is not None and not self.with_sigma and self.chain.try_hold(t_device):
            self.now_s = t_device  # not the first frame: that one was read
            return held
        readings = self.update(words, t_device, health)
        readout = self._readout_of(health)
        rest_v, rest_pa = readout.rest
        self.chain.hold(rest_v.copy(), rest_pa.copy(), readout.valid.copy())
        heard_s = self._heard_s
        fresh = heard_s[t_device - heard_s <= self.stale_after_s]
        named_s = self._named_s[t_device - self._named_s <= self.stale_after_s]
        next_s = min(fresh.min(initial=np.inf), named_s.min(initial=np.inf))
        self._stale_from_s = float(next_s) + self.stale_after_s
        self._silence = readings
        return readings

    def _sigma_pa(self, node_pa: Floats32, pressure_pa: Floats32, status: Uint8s) -> Floats32:
        """How sure readings are, (t,), Pa, 1 σ; node_pa: (n,), before the tare."""
        if self._uncertainty is None:
            self._uncertainty = Uncertainty(self.chain)
        spoke, source = self._heard_s == self.now_s, self._layout.source
        sigma_pa = self._uncertainty.sigma_pa(node_pa, spoke, self.now_s)
        if source is not None:
            sigma_pa = sigma_pa[source]  # of one without a node it is NaN, as its reading is
        sigma_pa = np.where(status & _SATURATED, np.inf, sigma_pa)
        return np.where(np.isfinite(pressure_pa), sigma_pa, np.nan).astype(np.float32)

    def _judged(self, status: Uint8s, now_s: float) -> Uint8s:
        """Return a copy of the status, (t,), with MASKED where taxels are left out as dead."""
        status, self.retired = status.copy(), ()
        named = status & _DEAD
        if not self.dead_share or _none(named):
            self._named_s.fill(np.inf)
            return status
        self._named_s = np.where(named, np.minimum(self._named_s, now_s), np.inf)
        dead = np.flatnonzero(now_s - self._named_s > self.stale_after_s)
        if 0 < len(dead) <= self.dead_share * np.count_nonzero(is_in_service(status)):
            status[dead] |= np.uint8(Status.MASKED)
            self.retired = tuple(sorted(self._layout.nodes[dead].tolist()))
        return status

    def _readout_of(self, health: NodeHealth) -> Readout:
        """Return the kernel's readout by the present verdicts and calibration."""
        chain = self.chain
        read_by = health.state, chain.calibration, chain.bounds
        if self._readout is None or any(map(is_not, read_by, self._read_by)):
            self._read_by = read_by
            self._readout = Readout(self, health)
        return self._readout


def _none(flags: Uint8s) -> bool:
    """Whether no flag is set: what np.any tells of few nodes in ten times the time."""
    return flags.tobytes() == bytes(flags.size)


def _numbers(nodes: Bools) -> list[int]:
    """The numbers of these nodes, (n,), which count from 1."""
    return [*map(int, np.flatnonzero(nodes) + 1)]


_SATURATED, _DEAD = np.uint8(Status.SATURATED), np.uint8(Status.STALE | Status.FAULTY)
_FLAGS_OF = np.zeros(len(NodeState), dtype=np.uint8)
_FLAGS_OF[NodeState.WEAK] = Status.WEAK
_FLAGS_OF[[NodeState.FAULTY, NodeState.DOUBLED]] = Status.FAULTY
