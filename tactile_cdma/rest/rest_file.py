# SPDX-License-Identifier: Apache-2.0

"""The YAML files that keep a skin's tare, drift and calibration between runs."""

import os
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
import yaml

from ..base.arrays import Floats32
from ..base.errors import CalibrationError, RestError
from ..base.marked_yaml import Keys, read_marked
from ..base.named_file import expanded, naming
from ..base.whole_file import keep_aside, replace_file
from ..readings.calibration import AdcScale, Calibration
from ..readings.calibration_file import CalibrationContent, read_content, write_content

SCHEMA = "tactile_cdma/rest"
VERSION = 1
_DIGITS = 8
"""Decimals of V that are kept: 10 nV is far below a count of any converter."""
_MOST_V = 100.0
"""Greatest voltage that is read, V; more is damage to the file."""
_SUFFIX = ".rest.yaml"
_HEAD = "# Written by the driver: what it takes off readings. Delete it to start anew.\n"


@dataclass(frozen=True, eq=False)
class RestState:
    """Holds what a skin reads at rest, and which skin that is.

    skin: its name; may be empty. simulated: it is not hardware; None: not known yet. scene: the
    sim:// URL by which the driver simulates it, or empty. nodes: their number. calibration:
    identity of the calibration, empty for the default one; for people. curves: checksum of its
    curves, without which tare and drift mean nothing. written: when, in ISO 8601. tared: when the
    tare was taken; empty: never, or unknown. rest_v, drift_v, tared_drift_v, least_v: (n,) float32,
    V, see Baseline; None: no tare, no drift, none when it was tared, no tare. masked: numbers of
    the nodes out of service.
    """

    skin: str
    simulated: bool | None
    scene: str
    nodes: int
    calibration: str
    curves: str
    written: str = ""
    tared: str = ""
    rest_v: Floats32 | None = None
    drift_v: Floats32 | None = None
    tared_drift_v: Floats32 | None = None
    least_v: Floats32 | None = None
    masked: tuple[int, ...] = ()

    def misfit(self, present: Self) -> str | None:
        """Tell why this is not the state of the skin that is present, or None.

        An empty name fits every name; so does an empty scene of the present skin.
        """
        if present.simulated is not None and self.simulated != present.simulated:
            kinds = ("a real", "a simulated") if present.simulated else ("a simulated", "a real")
            return f"it is of {kinds[0]} skin, this is {kinds[1]} one"
        if present.scene and self.scene != present.scene:
            return f"it is of {self.scene or 'another simulation'}, this is {present.scene}"
        if self.skin and present.skin and self.skin != present.skin:
            return f"it is of skin {self.skin!r}, this is {present.skin!r}"
        if self.nodes != present.nodes:
            return f"it is of a skin of {self.nodes} nodes, this one has {present.nodes}"
        if self.curves != present.curves:
            return (
                f"it goes with other curves (calibration {self.calibration or 'by default'}): "
                "tare again while nothing touches the skin"
            )
        return None


def rest_path(folder: str, node: str, simulated: bool = False) -> Path:
    """Name the file of a ROS node. node: its fully qualified name. simulated: by its port, sim://.

    Simulated skins have files of their own: trying one must not cost a board its tare.

    folder: may begin with ~; empty: $ROS_HOME/tactile_cdma, or ~/.ros/tactile_cdma.
    Raises RestError for the home of a user who does not exist, or has none.
    """
    text = folder or f"{os.environ.get('ROS_HOME') or '~/.ros'}/tactile_cdma"
    try:
        parent = expanded(text)
    except ValueError as error:
        raise RestError(f"{text}: tare and drift are not kept: {error}") from None
    kind = "-simulated" if simulated else ""  # no name has a hyphen
    return parent / f"{node.strip('/').replace('/', '.')}{kind}{_SUFFIX}"


def calibration_path(rest: Path) -> Path:
    """Name the file, beside a node's, of the calibration that its tare and drift go with."""
    return rest.with_name(rest.name.removesuffix(_SUFFIX) + ".calibration.yaml")


def write_rest(path: Path, state: RestState) -> None:
    """Replace the file atomically, creating its folder if necessary; raises RestError."""
    content = {
        "schema": SCHEMA,
        "version": VERSION,
        **vars(state),
        "simulated": _YES if state.simulated else _NO,
        **{name: _numbers(getattr(state, name)) for name in _ARRAYS},
        "masked": list(state.masked),
    }
    text = _HEAD + yaml.dump(content, Dumper=_DUMPER, sort_keys=False, allow_unicode=True)
    with naming(path, RestError, "tare and drift are not kept"):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, text, follow=False)  # the target of a link is not ours


def read_rest(path: Path) -> RestState | None:
    """Read a file; None if it does not exist.

    Raises RestError, naming file, line and cause, for anything but such a file.
    """
    if not os.path.lexists(path):
        return None
    file = read_marked(path, RestError).mapping("the file")
    file.check_schema(SCHEMA, VERSION)
    nodes = file["nodes"].whole("nodes", 1, 65_535)
    masked = file["masked"].items("masked", 0, nodes) if "masked" in file.entries else []
    values: dict[str, Any] = {name: file.text(name) for name in _TEXTS}
    return RestState(
        nodes=nodes,
        simulated=file.text("simulated") == _YES,
        scene=file.text("scene", default=""),
        masked=tuple(node.whole("a masked node", 1, nodes) for node in masked),
        **values | {name: _array(file, name, nodes) for name in _ARRAYS},
    )


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

    def read(self, present: RestState) -> RestState | None:
        """Return the state on file if it is the present skin's, see RestState.misfit; else None."""
        self._is_others = False
        if self.path is None:
            return None
        try:
            state = read_rest(self.path)
        except RestError as error:
            self.disown()
            self._log.warning(f"no tare and drift: {error}")
            return None
        if state is None or not (misfit := state.misfit(present)):
            return state
        if present.scene and state.simulated and state.scene != present.scene:
            self._log.info(f"{self.path}: tare and drift are not used, nor kept: {misfit}")
            return None
        self.disown()
        self._log.warning(f"{self.path}: tare and drift are not used: {misfit}")
        if not state.masked or state.misfit(replace(present, curves=state.curves)):
            return None
        return replace(present, masked=state.masked)  # other curves, the same nodes

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
        """Write the curves in force unless on file; the file's path. Raises TactileError."""
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
        """Keep what is to be overwritten under another name. Raises RestError."""
        with naming(path, RestError, "cannot be set aside"):
            aside = keep_aside(path)
        if aside:
            self._log.info(f"what was in {path} is kept in {aside}")


_TEXTS = ("skin", "calibration", "curves", "written", "tared")
_ARRAYS = ("rest_v", "drift_v", "tared_drift_v", "least_v")
_OLDER = {"tared_drift_v": "drift_v", "least_v": "rest_v"}  # of files without
_YES, _NO = "yes", "no"
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # 10 times as fast, where available


def _array(file: Keys, name: str, nodes: int) -> Floats32 | None:
    value = file[name if name in file.entries else _OLDER.get(name, name)]
    if value.is_null:
        return None
    return np.array(value.numbers(name, -_MOST_V, _MOST_V, "V", nodes, nodes), dtype=np.float32)


def _numbers(values: Floats32 | None) -> list[float] | None:
    return None if values is None else np.round(values.astype(np.float64), _DIGITS).tolist()
