# SPDX-License-Identifier: Apache-2.0

"""The files of one skin's tare, drift and calibration: reads what fits, overwrites only its own."""

from contextlib import suppress
from pathlib import Path
from typing import Protocol

from ..base.errors import CalibrationError, RestError
from ..readings.calibration import AdcScale, Calibration
from ..readings.calibration_file import CalibrationContent, read_content, write_content
from .rest_file import RestState, calibration_path, read_rest, set_aside, write_rest


class Log(Protocol):
    """Takes what the user should know; logging.Logger and a ROS node's logger both do."""

    def info(self, message: str, /) -> object:
        """Note something that happened."""

    def warning(self, message: str, /) -> object:
        """Note something to look into."""


class RestStore:
    """A file of tare and drift, and beside it one of the calibration that they go with.

    Files that do not fit the skin are never lost, but get another name before the next write.
    """

    def __init__(self, path: Path | None, log: Log, unkept: str = "") -> None:
        """path: see rest_path; None: nothing is read or kept. unkept: why that would be."""
        self.path, self._unkept = path, unkept
        self._log = log
        self._is_others = False

    def read(
        self, skin: str, simulated: bool | None, nodes: int, curves: str, scene: str
    ) -> RestState | None:
        """The state on file if it is that of such a skin (see RestState.misfit), else None."""
        self._is_others = False
        if self.path is None:
            return None
        try:
            state = read_rest(self.path)
        except RestError as error:
            self.disown()
            self._log.warning(f"no tare and drift: {error}")
            return None
        misfit = state and state.misfit(skin, simulated, nodes, curves, scene)
        if misfit and scene and state and state.simulated and state.scene != scene:
            self._log.info(f"{self.path}: tare and drift are not used, nor kept: {misfit}")
            return None
        if misfit:
            self.disown()
            self._log.warning(f"{self.path}: tare and drift are left aside: {misfit}")
            return None
        return state

    def disown(self) -> None:
        """Treat what is on file as another skin's: keep it aside at the next write."""
        self._is_others = True

    def write(self, state: RestState) -> Path:
        """Write the state to the file, whose path is returned. Raises RestError."""
        if self.path is None:
            raise RestError(self._unkept)
        if self._is_others:
            self._set_aside(self.path)
        self._is_others = False
        write_rest(self.path, state)
        return self.path

    def write_calibration(self, calibration: Calibration, adc: AdcScale, skin: str) -> Path:
        """Write the curves in force, unless they are on file already; returns the file's path.

        Raises TactileError.
        """
        assert self.path is not None
        path = calibration_path(self.path)
        source = f"the calibration {calibration.identity or 'by default'} of a running skin"
        content = CalibrationContent.of(calibration, adc, skin, source)
        with suppress(CalibrationError):  # missing, or of another skin
            if read_content(path, content.nodes, adc, skin).identity == content.identity:
                return path
        self._set_aside(path)
        write_content(path, content)
        return path

    def _set_aside(self, path: Path) -> None:
        if aside := set_aside(path):
            self._log.info(f"what was in {path} is kept in {aside}")
