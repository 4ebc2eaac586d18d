# SPDX-License-Identifier: Apache-2.0

"""The command `tactile-cdma calibrate`: known loads and what a skin measured → calibration file."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import CalibrationError, CaptureError
from ..base.listing import listed
from ..config.arguments import add_skin_options, finite, given, positive
from ..config.parameters import BY_NAME, Value
from ..config.skin_config import SkinConfig
from ..driver.pipeline import Pipeline
from ..readings.calibration import Calibration
from ..readings.calibration_file import (
    read_content,
    seal_calibration,
    write_calibration,
    write_content,
)
from ..recording.capture import capture_notes
from ..recording.offline import described_parameters, raw_frames
from . import dynamics_fit, report
from .load_points import LoadPoints, read_points
from .load_session import LiveSkin, LoadSession
from .plateaus import Recording, Reference, find_offset, plateau_points, read_reference
from .skin_fit import SkinFit, fit_skin

NODE_ORDER: dict[str, Value] = {"calibration_file": "", "layout_file": "", "rows": 0, "columns": 0}
"""Parameters under which taxel i is node i + 1, and no earlier calibration takes part."""
LONGEST_MS = 1e5
"""Points have no frames: a large skin need not fit into the default period."""
OF_CURVES: dict[str, Any] = {
    "pieces": 2,
    "rising": False,
    "allow_missing": False,
    "settle": 2.0,
    "port": None,
    "steps": (),
    "node": None,
    "seconds": 1.0,
    "append": False,
}
"""Options of the fit of curves, and their defaults. The paper's sensor takes 0.74 s to settle."""
OPTIONS_OF = {"port": ("steps", "node", "seconds", "append"), "capture": ("offset", "settle")}
"""Options that go with a source of loads only."""
MISLED_S = 0.3
"""By so much a sensor's lag may shift the offset of the clocks that is found."""


def add_to(commands: Any) -> None:
    """Add the command to those of the program (what argparse's add_subparsers returns)."""
    parser = commands.add_parser(
        "calibrate", help="fit the nodes' curves to known loads", description=__doc__
    )
    parser.add_argument(
        "loads",
        type=Path,
        nargs="?",
        metavar="LOADS.csv",
        help="points (node,pressure_kpa,voltage_v); with --capture the reference's readings "
        "(time_s,pressure_kpa and, if not all nodes are loaded alike, node); with --port the "
        "file that the points are kept in",
    )
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="calibration file")
    parser.add_argument("--png", type=Path, metavar="FILE", help="picture (beside the output)")
    parser.add_argument("--force", action="store_true", help="overwrite the output")
    parser.add_argument("--skin", help="name of this very skin (the parameter skin)")
    parser.add_argument("--pieces", type=_pieces, help=f"of every curve ({OF_CURVES['pieces']})")
    parser.add_argument(
        "--rising",
        action="store_true",
        help="only loads above the one before count: for a skin that will be compensated",
    )
    parser.add_argument(
        "--allow-missing",
        action="store_true",
        help="nodes without a sound curve become uncalibrated; else nothing is written",
    )
    parser.add_argument(
        "--area-mm2", type=positive, metavar="MM2", help="that a force_n of the loads acts on"
    )
    parser.add_argument(
        "--seal", type=Path, metavar="FILE", help="accept a calibration file edited by hand"
    )
    capture = parser.add_argument_group("loads beside a capture")
    capture.add_argument("--capture", type=Path, metavar="RAW", help="from tactile-cdma record")
    capture.add_argument(
        "--offset", type=finite, help="device time minus the reference's time [s] (found)"
    )
    capture.add_argument(
        "--settle",
        type=positive,
        help=f"left out after a load came to rest [s] ({OF_CURVES['settle']:g})",
    )
    capture.add_argument(
        "--dynamics",
        type=Path,
        metavar="FILE",
        help="a calibration file that lag and hysteresis, seen in loading cycles, are added to",
    )
    live = parser.add_argument_group("loads taken step by step")
    live.add_argument("--port", help="pyserial URL of the digitizer")
    live.add_argument("--baud", type=int, default=BY_NAME["baud"].default)
    live.add_argument("--steps", type=_steps, metavar="0,10,…", help="loads [kPa]")
    live.add_argument("--node", type=int, help="the one that is loaded (all, alike)")
    live.add_argument(
        "--seconds",
        type=positive,
        help=f"that a load is measured ({OF_CURVES['seconds']:g})",
    )
    live.add_argument("--append", action="store_true", help="go on with a file of points")
    add_skin_options(parser, "what a capture says, else the driver's")
    parser.set_defaults(run=run, **OF_CURVES)


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit code."""
    if arguments.seal:
        print(f"identity={seal_calibration(arguments.seal)}")
        return 0
    output, loads = _files(arguments)
    values = given(arguments) | NODE_ORDER
    if arguments.skin is not None:
        values["skin"] = arguments.skin
    area_m2 = arguments.area_mm2 and arguments.area_mm2 * 1e-6
    if arguments.capture:
        config = SkinConfig.of(_described(arguments.capture) | values)
        reference = read_reference(loads, config.spec.nodes, area_m2)
        if arguments.dynamics:
            return _add_dynamics(arguments, output, config, reference)
        recording, offset_s = _beside_capture(arguments, reference, config)
        points = plateau_points(reference, recording, offset_s, arguments.settle, config.adc)
    else:
        if not arguments.port:
            values["frame_period_ms"] = LONGEST_MS
        config = SkinConfig.of(values)
        if arguments.port and not _take_loads(arguments, loads, config):
            return 1
        points = read_points(loads, config.spec.nodes, config.adc.vref_v, area_m2)
    return _fit(arguments, output, config, points)


def _fit(
    arguments: argparse.Namespace, output: Path, config: SkinConfig, points: LoadPoints
) -> int:
    nodes = config.spec.nodes
    if arguments.rising:
        taken, points = len(points), points.rising(nodes)
        print(f"{len(points)} of {taken} points are of rising loads")
    fit = fit_skin(points, nodes, config.adc, arguments.pieces)
    print(report.describe(fit))
    for warning in report.warnings(fit, config.curve):
        print(f"warning: {warning}")
    _check_missing(fit, arguments.allow_missing)
    calibration = Calibration.of_nodes(fit.curves, config.curve, nodes)
    identity = write_calibration(output, calibration, config.adc, config.skin, points.source)
    picture = _picture(arguments, output)
    report.draw(fit, picture)
    _conclude(output, picture, report.results(fit) | {"identity": identity})
    return 0


def _add_dynamics(
    arguments: argparse.Namespace, output: Path, config: SkinConfig, reference: Reference
) -> int:
    content = read_content(arguments.dynamics, config.spec.nodes, config.adc, config.skin)
    recording, offset_s = _beside_capture(arguments, reference, config)
    found = dynamics_fit.find_dynamics(
        content.calibration(config.curve),
        reference,
        recording,
        offset_s,
        uncertain_s=MISLED_S if arguments.offset is None else 0.0,
    )
    print(dynamics_fit.describe(found))
    source = ", ".join(filter(None, (content.source, f"dynamics: {reference.path.name}")))
    identity = write_content(output, replace(content, dynamics=found.dynamics, source=source))
    picture = _picture(arguments, output)
    dynamics_fit.draw(found, picture)
    _conclude(output, picture, dynamics_fit.results(found) | {"identity": identity})
    return 0


def _picture(arguments: argparse.Namespace, output: Path) -> Path:
    return arguments.png or output.with_suffix(".png")


def _conclude(output: Path, picture: Path, results: dict[str, str]) -> None:
    print(f"written: {output}, {picture}")
    print(" ".join(f"{key}={value}" for key, value in results.items()))


def _files(arguments: argparse.Namespace) -> tuple[Path, Path]:
    """Output and loads; what cannot be meant is refused before anything is done."""
    output: Path | None = arguments.output
    if output is None:
        raise CalibrationError("-o is missing: the calibration file to write")
    _check_options(arguments)
    loads: Path | None = arguments.loads
    if loads is None:
        if not arguments.port:
            raise CalibrationError("which loads? Give a CSV file, or --port to take them now")
        loads = output.with_suffix(".points.csv")
    if arguments.port:
        _check_writable(loads, True, ())
    _check_writable(output, arguments.force, (loads, arguments.capture))
    inputs = (loads, arguments.capture, arguments.dynamics)
    _check_writable(_picture(arguments, output), True, (*inputs, output))
    return output, loads


def _check_writable(path: Path, force: bool, others: Iterable[Path | None]) -> None:
    """Raises CalibrationError where a file cannot be, or would overwrite what is still needed."""
    if any(other is not None and path.resolve() == other.resolve() for other in others):
        raise CalibrationError(f"{path}: would overwrite another file of this very command")
    if path.exists() and not path.is_file():
        raise CalibrationError(f"{path}: is no file that could be overwritten")
    if path.exists() and not force:
        raise CalibrationError(f"{path}: exists already; --force overwrites it")
    if not path.parent.is_dir():
        raise CalibrationError(f"{path}: there is no such folder")


def _check_options(arguments: argparse.Namespace) -> None:
    """Raises CalibrationError for options that do not go with each other."""
    if arguments.dynamics:
        _check_dynamics(arguments)
    if arguments.port and arguments.capture:
        raise CalibrationError("--port and --capture: loads come from one of the two")
    for source, names in OPTIONS_OF.items():
        for name in () if getattr(arguments, source) else names:
            if getattr(arguments, name) != OF_CURVES.get(name):
                raise CalibrationError(f"--{name} goes with --{source} only")


def _check_dynamics(arguments: argparse.Namespace) -> None:
    """Raises CalibrationError for what does not go with --dynamics."""
    for name, default in OF_CURVES.items():
        if getattr(arguments, name) != default:
            raise CalibrationError(
                f"--{name.replace('_', '-')} is for curves; --dynamics adds to those of "
                f"{arguments.dynamics}"
            )
    if not arguments.capture:
        raise CalibrationError("--dynamics takes loading cycles: give --capture, too")
    try:
        import scipy.optimize  # noqa: F401
    except ImportError as error:
        raise CalibrationError(
            f"--dynamics needs scipy ({error}): sudo apt install python3-scipy, or "
            "pip install 'tactile_cdma[calibrate]'"
        ) from None


def _described(capture: Path) -> dict[str, Value]:
    try:
        return described_parameters(capture)
    except OSError as error:
        raise CaptureError(f"{capture}: {error.strerror}") from None


def _beside_capture(
    arguments: argparse.Namespace, reference: Reference, config: SkinConfig
) -> tuple[Recording, float]:
    """What the nodes measured, and its time minus the reference's, s."""
    recording = read_recording(arguments.capture, config)
    for note in capture_notes(arguments.capture):
        print(f"tactile-cdma: {arguments.capture}: {note}", file=sys.stderr)
    if arguments.offset is not None:
        return recording, float(arguments.offset)
    found = find_offset(reference, recording, config.curve)
    print(
        f"offset of the clocks: {found.offset_s:.2f} ± {found.error_s:.2f} s (match "
        f"{found.match:.3f})"
    )
    return recording, found.offset_s


def read_recording(path: Path, config: SkinConfig) -> Recording:
    """What the nodes measured in a raw capture; config: with taxels in the order of the nodes.

    Raises CaptureError where there is no frame in it.
    """
    pipeline = Pipeline(config, background=False)
    times_s, rows = [], []
    for frame in raw_frames(path, pipeline):
        times_s.append(frame.t_middle)
        rows.append(frame.readings.voltage_v)
    if not rows:
        raise CaptureError(f"{path}: {pipeline.problem or 'no frame found'}")
    return Recording(np.array(times_s), np.array(rows))


def _take_loads(arguments: argparse.Namespace, path: Path, config: SkinConfig) -> bool:
    """Whether loads were taken until their end."""
    nodes = config.spec.nodes
    if arguments.node is not None and not 1 <= arguments.node <= nodes:
        raise CalibrationError(f"--node is {arguments.node}; the skin has nodes 1…{nodes}")
    loaded = range(1, nodes + 1) if arguments.node is None else [arguments.node]
    with LiveSkin(config, arguments.port, arguments.baud) as skin:
        session = LoadSession(
            skin, input, lambda text: print(text, flush=True), loaded, arguments.seconds
        )
        try:
            taken = session.run(path, arguments.steps, arguments.append)
        except KeyboardInterrupt:
            kept = (
                f"{path} has the loads taken so far: --append goes on with it, without --port it "
                "is fitted"
            )
            print(
                f"\ntactile-cdma: interrupted; {kept if path.exists() else 'no load was taken'}",
                file=sys.stderr,
            )
            return False
    print(f"{taken} loads taken, kept in {path}")
    return True


def _check_missing(fit: SkinFit, allow_missing: bool) -> None:
    source = fit.points.source
    if not fit.curves:
        raise CalibrationError(f"{source}: no node has a sound curve; nothing is written")
    if fit.refused and not allow_missing:
        raise CalibrationError(
            f"{source}: no sound curve for {listed(list(fit.refused), 'node')} (see above); "
            "nothing is written: mend the loads, or take the default curve for them with "
            "--allow-missing"
        )


def _pieces(text: str) -> int:
    if not (text.isdecimal() and 1 <= int(text) <= 8):
        raise argparse.ArgumentTypeError(f"{text!r}: a curve has 1 to 8 pieces")
    return int(text)


def _steps(text: str) -> tuple[float, ...]:
    try:
        steps = tuple(float(step) for step in text.split(","))
    except ValueError:
        steps = (math.nan,)
    if not all(0 <= step < math.inf for step in steps):
        raise argparse.ArgumentTypeError(f"{text!r}: loads in kPa, as in 0,10,20")
    return steps
