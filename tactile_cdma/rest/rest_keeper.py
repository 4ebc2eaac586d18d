# SPDX-License-Identifier: Apache-2.0

"""Tare, drift and calibration of a running skin: restored at its start, changed, saved."""

import time
from collections.abc import Callable, Collection
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from threading import Lock

import numpy as np

from ..base.arrays import Floats32
from ..base.errors import Refusal, RestError
from ..base.text import listed
from ..config.parameters import REPLAY, SIMULATION
from ..config.skin_config import SkinConfig
from ..driver.driver import Driver
from ..readings.baseline import Baseline
from ..readings.taxels import Taxels
from .rest_file import Log, RestState, RestStore

TELL_S = 10.0
"""Least time between two reports of drift, s: each makes every subscriber take the layout anew."""
SAVE_S = 60.0
"""Least time between two writes of drift, s; a crash loses at most this much of it."""
_TOLD_LSB = 0.9
"""Drift is reported when it has moved by this much, LSB: by one count, whatever the rounding."""
_SAVED_LSB = 0.1
"""Drift is saved when it has moved by this much, LSB; less changes no reading."""


class RestKeeper:
    """Tare and drift of one skin, kept in a file from one run to the next.

    Call it from any one thread but the driver's, which goes on meanwhile; but hear() from that.

    config: in force. tared: when the tare in force was taken, in ISO 8601; empty without one.
    masked: numbers of the nodes that `mask` took out of service.
    """

    def __init__(
        self,
        config: SkinConfig,
        url: str,
        path: Path | None,
        log: Log,
        on_change: Callable[[], None],
        no_path: str = "",
    ) -> None:
        """Read the file of this skin, if there is one.

        url: of the port. A recording's tare and drift are neither read nor kept: every replay of
        it is the same, and says nothing about the skin of today. path: see rest_path; None: they
        are not kept either, and no_path says why. on_change: called between frames when other
        tare, drift or curves apply.
        """
        self.config, self.tared = config, ""
        self.masked: tuple[int, ...] = ()
        self._log, self._on_change = log, on_change
        # Other ports, too, may lead to a simulator or an emulator: the digitizer says it.
        self._simulated = True if url.lower().startswith(SIMULATION) else None
        self._scene = url if self._simulated else ""
        self._is_recording = url.lower().startswith(REPLAY)
        if self._is_recording:
            path, no_path = None, "tare and drift of a recording that is replayed are not kept"
        elif no_path:
            log.warning(no_path)
        self._store = RestStore(path, log, no_path)
        self._driver: Driver | None = None
        self._kept: RestState | None = None  # as last read or written; in force while inactive
        self._lock, self._drops = Lock(), 0  # of _kept; how often hear() dropped it
        self._told_drift_v: Floats32 | None = None
        self._told_retired: tuple[int, ...] = ()
        self._told_s = self._saved_s = 0.0
        self._is_writable, self._has_new_curves = True, False
        self._read()

    @property
    def taxels(self) -> Taxels | None:
        """Return what has tare, drift and masks in force; None while inactive."""
        return None if self._driver is None else self._driver.pipeline.taxels

    @property
    def baseline(self) -> Baseline | None:
        """Tare and drift in force; None while inactive."""
        return None if self.taxels is None else self.taxels.baseline

    def activate(self, driver: Driver) -> None:
        """Put into force what was found before; the driver does not run yet."""
        self._driver, kept = driver, self._kept
        if kept is not None:
            taxels = driver.pipeline.taxels
            taxels.restore(kept.rest_v, kept.drift_v, kept.tared_drift_v, kept.least_v)
            if kept.rest_v is not None or kept.drift_v is not None:
                text = (
                    f"tare and drift are those of {kept.written} in "
                    f"{self._store.path or 'memory'}: {_taken_off(taxels.baseline.tare_pa)}"
                )
                if kept.simulated:
                    self._log.warning(
                        f"{text}; they were found on a simulated skin, call ~/tare with clear: "
                        "true to forget them"
                    )
                else:
                    self._log.info(text)
        if self.masked:
            self._log.info(f"masked by ~/mask: {listed(self.masked, 'node')}")
        driver.pipeline.taxels.mask(service=self.masked)
        self._tell()

    def hear(self, simulated: bool) -> None:
        """Take in what the digitizer says that it is; in the driver's thread, between frames.

        Tare and drift in force that were found on the other kind of skin are dropped, also those
        that are not on file.
        """
        with self._lock:
            found, self._simulated = self._present(), simulated
            held = found.rest_v, found.drift_v, found.masked or None, self._kept
            nothing = all(each is None for each in held)
            if self._driver is None or nothing or found.simulated == simulated:
                return
            taxels = self._driver.pipeline.taxels
            taxels.restore()
            taxels.mask(service=())
            self._store.disown()
            self._kept, self.tared, self.masked, self._drops = None, "", (), self._drops + 1
        misfit = found.misfit(replace(found, simulated=simulated))
        self._log.warning(f"{self._store.path}: tare and drift are dropped: {misfit}")

    def deactivate(self) -> None:
        """Save what has changed; the driver has stopped."""
        self._save_changes()
        if self._is_recording:
            self.tared, self.masked = "", ()
        else:
            self._kept = self._present()  # even where it could not be written
        self._driver = None

    def adjust(self, config: SkinConfig) -> None:
        """Put other parameters into force, perhaps another calibration."""
        recalibrated = config.calibration is not self.config.calibration
        remasked = config.masked != self.config.masked
        self.config = config
        if self._driver is None:
            if recalibrated:
                self._read()
            return
        with self._driver.between_frames() as pipeline:
            pipeline.adjust(config)
            if recalibrated or remasked:
                self._tell()
        if not recalibrated:
            return
        self._has_new_curves = True
        if self._kept is not None and self._store.path is not None:
            self._save()  # on file they are with the curves that they are used with

    def tick(self) -> None:
        """Report and save drift if that is due; call it about once a second."""
        if self._driver is None or self._told_drift_v is None:
            return
        if self._has_new_curves:  # perhaps by several parameters, one after the other
            self._has_new_curves = False
            name = self.config.calibration.identity or "by default"
            self._log.info(f"calibration {name} is in use; tare and drift stay, by its curves")
        now_s, lsb_v = time.monotonic(), self.config.adc.lsb_v
        taxels = self._driver.pipeline.taxels
        moved_v = np.abs(taxels.baseline.drift_v - self._told_drift_v).max()
        has_drifted = moved_v > _TOLD_LSB * lsb_v and now_s - self._told_s >= TELL_S
        if has_drifted or taxels.retired != self._told_retired:
            with self._driver.between_frames():
                self._tell()
        if now_s - self._saved_s >= SAVE_S:
            self._save_changes()

    def tare(self, force: bool | str = False) -> str:
        """Make what is read now zero, and save it; what was done. force: see take_tare.

        Nodes without a valid, certain reading keep the tare they had. Raises RestError, also where
        no frames come.
        """
        with self._streaming().between_frames() as pipeline:
            unheard = pipeline.taxels.tare(self.config.rest.contact_pa, force)
            self.tared = _now()
            self._tell()
            text = f"tared: {_taken_off(pipeline.taxels.baseline.tare_pa)}"
        if unheard:
            text += f"; as before, without a certain reading: {listed(unheard, 'node')}"
        return self._done(text)

    def clear(self) -> str:
        """Forget tare and drift, on file too; what was done. Raises RestError without frames."""
        with self._streaming().between_frames() as pipeline:
            pipeline.taxels.restore()
            self.tared = ""
            self._tell()
        return self._done("tare and drift are forgotten")

    def mask(self, nodes: Collection[int], back: bool = False) -> str:
        """Take nodes out of service, and save it; what was done. Raises RestError.

        back: put them back instead; without nodes, all that were masked here.
        """
        config, asked = self.config, {*nodes}
        others = {*config.layout.masked, *config.masked}
        if wrong := sorted(n for n in asked if not 1 <= n <= config.spec.nodes):
            skin = f"the skin has {config.spec.nodes} nodes"
            raise RestError(f"not masked: {skin}, and no {listed(wrong, 'node')}")
        if fixed := sorted(asked & others if back else ()):
            by = "the layout, or the parameter masked, has it: put it back there"
            raise RestError(f"still masked: {listed(fixed, 'node')}: {by}")
        if not asked and not back:
            raise RestError("not masked: nodes is empty; name them, or set clear")
        kept = {*self.masked} - (asked or {*self.masked}) if back else {*self.masked} | asked
        with self._lock:
            self.masked = tuple(sorted(kept))
        if self._driver is not None:
            with self._driver.between_frames() as pipeline:
                pipeline.taxels.mask(service=self.masked)
                self._tell()
        masked = listed(sorted(kept | others), "node") if kept | others else "none"
        return self._done(f"out of service: {masked}")

    def save(self) -> tuple[Path, Path]:
        """Write tare and drift, and the curves; paths of both files. Raises TactileError."""
        config = self.config
        path = self._write()
        return path, self._store.write_calibration(config.calibration, config.adc, config.skin)

    def _done(self, text: str) -> str:
        """Save what was changed; log and return it in a sentence."""
        if unkept := self._save():
            text += f"; in memory only: {unkept}"
        self._log.info(text)
        return text

    def _streaming(self) -> Driver:
        if self._driver is None:
            reason = "not tared: the skin is not active; activate it first"
            raise RestError(reason, Refusal.INACTIVE)
        if self._driver.problem:
            reason = f"not tared: no frames arrive: {self._driver.problem}"
            raise RestError(reason, Refusal.NO_FRAMES)
        return self._driver

    def _tell(self) -> None:
        """Call on_change; between frames."""
        assert self._driver is not None
        taxels = self._driver.pipeline.taxels
        self._told_drift_v, self._told_retired = taxels.baseline.drift_v, taxels.retired
        self._told_s = time.monotonic()
        self._on_change()

    def _read(self) -> None:
        self._kept = self._store.read(self._untared)
        self.tared, self.masked = (kept.tared, kept.masked) if (kept := self._kept) else ("", ())

    def _save_changes(self) -> None:
        """Save if what is on file differs from what is in force."""
        if self._store.path is None:
            return
        self._saved_s = time.monotonic()
        kept, present = self._kept, self._present()
        kept_drift_v = 0.0 if kept is None or kept.drift_v is None else kept.drift_v
        drift_v = 0.0 if present.drift_v is None else present.drift_v
        moved_v = np.abs(drift_v - kept_drift_v).max()
        retared = self.tared != ("" if kept is None else kept.tared)
        if retared or moved_v > _SAVED_LSB * self.config.adc.lsb_v:
            self._save()

    def _save(self) -> str:
        """Write what is in force; returns why that has failed, which is logged once, or nothing."""
        try:
            self._write()
        except RestError as error:
            if self._is_writable:
                self._log.warning(str(error))
            self._is_writable = False
            return str(error)
        return ""

    def _write(self) -> Path:
        with self._lock:
            state, drops = self._present(), self._drops
        path = self._store.write(state)
        with self._lock:
            if self._drops == drops:
                self._kept = state
            else:  # what is on file now was dropped meanwhile
                self._store.disown()
        self._is_writable, self._saved_s = True, time.monotonic()
        return path

    @property
    def _untared(self) -> RestState:
        config, calibration = self.config, self.config.calibration
        return RestState(
            *(config.skin, self._simulated, self._scene, config.spec.nodes),
            *(calibration.identity, calibration.curves.checksum),
        )

    def _present(self) -> RestState:
        """Return the state in force; while inactive, the last one."""
        state = replace(self._untared, written=_now(), tared=self.tared, masked=self.masked)
        if state.simulated is None:
            state = replace(state, simulated=self._kept is not None and self._kept.simulated)
        if (present := self.baseline or self._kept) is None:
            return state
        state = replace(state, rest_v=present.rest_v, least_v=present.least_v)
        drift_v, tared_drift_v = (
            some_v if some_v is not None and some_v.any() else None
            for some_v in (present.drift_v, present.tared_drift_v)
        )
        return replace(state, drift_v=drift_v, tared_drift_v=tared_drift_v)


def _taken_off(tare_pa: Floats32) -> str:
    low, high = float(tare_pa.min()) / 1e3, float(tare_pa.max()) / 1e3
    return f"{low:.2f} to {high:.2f} kPa are taken off"


def _now() -> str:
    return datetime.now().astimezone().isoformat(timespec="seconds")
