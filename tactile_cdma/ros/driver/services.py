# SPDX-License-Identifier: Apache-2.0

"""What outlives a frame: tare and drift, the services that set them, the file that keeps them."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rclpy.lifecycle import LifecycleNode
from std_srvs.srv import Trigger

from tactile_cdma.srv import Tare

from ...base.errors import CalibrationError, RestError, TactileError
from ...base.listing import listed
from ...config.parameters import REPLAY, SIMULATION
from ...config.skin_config import SkinConfig
from ...driver.driver import Driver
from ...readings.calibration_file import CalibrationContent, read_calibration, write_calibration
from ...readings.rest_file import RestState, calibration_path, read_rest, set_aside, write_rest
from ..common import convert

TELL_S = 10.0
"""Drift is told of at most so often."""
SAVE_S = 60.0
"""Drift is saved at most so often."""
_TOLD_LSB = 0.9
"""A drift of a count is told of, however it is rounded."""
_SAVED_LSB = 0.1
"""A drift that moved by less is not worth writing."""


class RestKeeper:
    """Tare and drift of one skin: reads, applies, changes, tells of and saves them.

    All of it happens in the executor's thread; the driver's goes on.
    """

    def __init__(self, node: LifecycleNode, tell: Callable[[], None]) -> None:
        """tell: publishes the skin's info anew; called while no frame is on its way."""
        self._node, self._log, self._tell = node, node.get_logger(), tell
        self._driver: Driver | None = None
        self._config: SkinConfig | None = None
        self._path = Path()
        self._state: RestState | None = None  # as it was read or written last
        self._simulated = self._replayed = False
        self._others_file = False  # what is on disk is not ours to overwrite
        self._writable = True
        self._tared = ""
        self._told_drift_v: NDArray[np.float32] | None = None
        self._told_s = self._saved_s = 0.0
        node.create_service(Tare, "~/tare", self._on_tare)
        node.create_service(Trigger, "~/save_calibration", self._on_save)

    # Lifecycle

    def configure(self, config: SkinConfig, path: Path, port: str) -> None:
        """Read the file of this skin, if there is one; path: see rest_path.

        Of a recording nothing is read or kept: every replay of it is the same, and says nothing of
        how the skin is now.
        """
        self._path, self._config, self._writable = path, config, True
        self._simulated, self._replayed = port.startswith(SIMULATION), port.startswith(REPLAY)
        self._read()

    def activate(self, driver: Driver) -> None:
        """Apply what was found before; the driver does not run yet."""
        self._driver, state = driver, self._state
        if state is not None:
            driver.pipeline.taxels.restore(state.rest_v, state.drift_v)
            if state.rest_v is not None or state.drift_v is not None:
                taken_off = _taken_off(driver.pipeline.taxels.baseline.tare_pa)
                self._log.info(
                    f"tare and drift are those of {state.written} in {self._path}: {taken_off}"
                )
        self.tell()

    def deactivate(self) -> None:
        """Save what has changed; the driver has stopped."""
        if self._driver is not None:
            self._save_changes()
            if self._replayed:
                self._tared = ""
            else:
                self._state = self._present_state()  # even where it could not be written
            self._driver = None

    def release(self) -> None:
        """Nothing is configured any more."""
        self._config = None

    def tell(self) -> None:
        """Publish the skin's info; call it between frames."""
        assert self._driver is not None
        self._told_drift_v = self._driver.pipeline.taxels.baseline.drift_v
        self._told_s = time.monotonic()
        self._tell()

    def adjust(self, config: SkinConfig) -> None:
        """Other parameters are in force, maybe another calibration."""
        before, self._config = self._config, config
        assert before is not None
        if self._driver is None:
            if config.calibration is not before.calibration:
                self._read()
            return
        with self._driver.between_frames() as pipeline:
            stay = pipeline.adjust(config)
            if config.calibration is before.calibration:
                return
            if not stay:
                self._state, self._others_file, self._tared = None, True, ""
            self.tell()
        name = config.calibration.identity or "by default"
        self._log.info(
            f"calibration {name} is in force; tare and drift "
            + ("stay" if stay else "went with the curves before: tare while nothing touches it")
        )

    def tick(self) -> None:
        """Now and then: tell of drift, and save it."""
        if self._driver is None or self._told_drift_v is None:
            return
        config, now_s = self._driver.pipeline.config, time.monotonic()
        moved_v = np.abs(self._driver.pipeline.taxels.baseline.drift_v - self._told_drift_v).max()
        if moved_v > _TOLD_LSB * config.adc.lsb_v and now_s - self._told_s >= TELL_S:
            with self._driver.between_frames():
                self.tell()
        if now_s - self._saved_s >= SAVE_S:
            self._save_changes()

    @property
    def tared(self) -> str:
        """When the tare in force was taken, in ISO 8601; empty: there is none."""
        return self._tared

    # Services

    def _on_tare(self, request: Tare.Request, response: Tare.Response) -> Tare.Response:
        if self._driver is None:
            response.message = "not tared: the skin is not active; activate the node first"
            return response
        if self._driver.problem:
            response.message = f"not tared: no frames arrive: {self._driver.problem}"
            return response
        with self._driver.between_frames() as pipeline:
            taxels, config = pipeline.taxels, pipeline.config
            try:
                if request.clear:
                    taxels.restore()
                    response.message = "tare and drift are forgotten"
                else:
                    unheard = taxels.tare(config.rest.contact_pa, request.force)
                    response.message = _report(taxels.baseline.tare_pa, unheard)
                response.success = True
            except RestError as error:
                response.message = str(error)
            else:
                self._tared = "" if request.clear else _now()
                self.tell()
            baseline = taxels.baseline
        response.offset = convert.by_taxel(config.layout, baseline.tare_pa)
        response.drift = convert.by_taxel(config.layout, baseline.drift_v)
        if response.success:
            self._log.info(response.message)
            self._save()
        else:
            self._log.warning(response.message)
        return response

    def _on_save(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._config is None:
            response.message = "not saved: the node is not configured; configure it first"
            return response
        try:
            self._write()
            calibration = self._write_calibration()
        except TactileError as error:
            response.message = str(error)
        else:
            response.success = True
            response.message = f"saved {self._path} and {calibration}"
        return response

    # The file

    def _read(self) -> None:
        """What the file says, if it is of this skin as it is configured."""
        assert self._config is not None
        config, state, self._others_file = self._config, None, False
        if self._replayed:
            self._state, self._tared = None, ""
            return
        try:
            state = read_rest(self._path)
        except RestError as error:
            self._others_file = True
            self._log.warning(f"no tare and drift: {error}")
        curves = config.calibration.curves.checksum
        misfit = state and state.misfit(config.skin, self._simulated, config.spec.nodes, curves)
        if misfit:
            self._log.warning(f"{self._path}: tare and drift are left aside: {misfit}")
            state, self._others_file = None, True
        self._state, self._tared = state, state.tared if state else ""

    def _save_changes(self) -> None:
        """Save if that makes a difference."""
        if self._replayed:
            return
        self._saved_s = time.monotonic()
        assert self._driver is not None
        baseline, kept = self._driver.pipeline.taxels.baseline, self._state
        kept_drift_v = 0.0 if kept is None or kept.drift_v is None else kept.drift_v
        moved_v = np.abs(baseline.drift_v - kept_drift_v).max()
        retared = self._tared != ("" if kept is None else kept.tared)
        if retared or moved_v > _SAVED_LSB * self._driver.pipeline.config.adc.lsb_v:
            self._save()

    def _save(self) -> None:
        """Write what is in force; that this fails is logged once."""
        try:
            self._write()
        except RestError as error:
            if self._writable:
                self._log.warning(str(error))
            self._writable = False

    def _write(self) -> None:
        """Write what is in force; raises RestError."""
        if self._replayed:
            raise RestError("tare and drift of a recording that is replayed are not kept")
        state = self._present_state()
        if self._others_file:
            self._set_aside(self._path)
        self._others_file = False
        write_rest(self._path, state)
        self._state, self._writable, self._saved_s = state, True, time.monotonic()

    def _set_aside(self, path: Path) -> None:
        """Keep what is in a file that is about to be written; raises RestError."""
        if aside := set_aside(path):
            self._log.info(f"what was in {path} is in {aside} now")

    def _write_calibration(self) -> Path:
        """Write the curves in force beside tare and drift, if they are not; raises TactileError."""
        assert self._config is not None
        config, path = self._config, calibration_path(self._path)
        content = CalibrationContent.of(config.calibration, config.adc, config.skin)
        try:
            kept = read_calibration(path, content.nodes, config.adc, config.curve, config.skin)
            if kept.identity == content.identity:
                return path
        except CalibrationError:
            pass  # not there, or not ours
        self._set_aside(path)
        source = f"the calibration {config.calibration.identity or 'by default'} of a running skin"
        write_calibration(path, config.calibration, config.adc, config.skin, source)
        return path

    def _present_state(self) -> RestState:
        """What is in force; while nothing streams, what was last."""
        assert self._config is not None
        config, kept, curves = self._config, self._state, self._config.calibration.curves
        rest_v = drift_v = None
        if self._driver is not None:
            baseline = self._driver.pipeline.taxels.baseline
            rest_v = baseline.rest_v
            drift_v = baseline.drift_v if baseline.drift_v.any() else None
        elif kept is not None:
            rest_v, drift_v = kept.rest_v, kept.drift_v
        return RestState(
            skin=config.skin,
            simulated=self._simulated,
            nodes=config.spec.nodes,
            calibration=config.calibration.identity,
            curves=curves.checksum,
            written=_now(),
            tared=self._tared,
            rest_v=rest_v,
            drift_v=drift_v,
        )


def _taken_off(tare_pa: NDArray[np.float32]) -> str:
    low, high = float(tare_pa.min()) / 1e3, float(tare_pa.max()) / 1e3
    return f"{low:.2f} to {high:.2f} kPa are taken off"


def _report(tare_pa: NDArray[np.float32], unheard: list[int]) -> str:
    """What a tare did, for people."""
    text = f"tared: {_taken_off(tare_pa)}"
    if unheard:
        text += f"; without a valid reading and as before: {listed(unheard, 'node')}"
    return text


def _now() -> str:
    return datetime.now().astimezone().isoformat(timespec="seconds")
