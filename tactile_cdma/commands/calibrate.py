# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma calibrate`: fits a calibration file to known loads."""

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np

from ..base.errors import CalibrationError, CaptureError
from ..base.named_file import naming
from ..base.program import tell
from ..base.text import listed
from ..calibrating import report
from ..calibrating.load_points import LoadPoints, read_points
from ..calibrating.load_session import LoadSession
from ..calibrating.plateaus import Recording, Reference, find_offset, plateau_points, read_reference
from ..calibrating.skin_fit import POWER_LAW, fit_skin
from ..config.arguments import add_skin_options, finite, given, positive, refuse_given
from ..config.parameters import BY_NAME, Value
from ..config.skin_config import SkinConfig
from ..driver.driver import Driver
from ..driver.pipeline import Pipeline, TactileFrame
from ..readings import calibration_file
from ..readings.calibration import Calibration, PressureCurve
from ..recording.offline import described_parameters, raw_frames
from ..recording.recording_file import capture_notes

NODE_ORDER: dict[str, Value] = {"calibration_file": "", "layout_file": "", "rows": 0, "columns": 0}
"""Parameters under which taxel i is node i + 1, and no earlier calibration takes part."""
WORST = 5
"""Most nodes whose differences are printed."""
LONGEST_MS = 1e5
"""Frame period for tables of points, which have no frames, ms: long enough for any skin."""
OPTIONS_OF = {"port": ("steps", "seconds", "append"), "capture": ("offset", "settle")}
"""Options that go with a source of loads only."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    file: dict[str, Any] = {"type": Path, "metavar": "FILE"}
    add = parser.add_argument
    text = (
        "points (node,pressure_kpa,voltage_v); with --capture the reference's readings "
        "(time_s,pressure_kpa and, if not all nodes are loaded alike, node); with --port the "
        "file in which the points are stored"
    )
    add("loads", type=Path, nargs="?", metavar="LOADS.csv", help=text)
    add("-o", "--output", **file, help="calibration file to write")
    add("--png", **file, help="picture to draw (beside the output)")
    text = "overwrite the output; accept loads beyond range_kpa"
    add("--force", action="store_true", help=text)
    add("--update", **file, help="calibration file in which the loaded nodes get new curves")
    add("--skin", help="name of this individual skin (the parameter skin)")
    text = "pieces per curve (%(default)s)"
    add("--pieces", type=int, choices=range(1, 9), default=2, help=text)
    text = "curves of force sensing resistors, R ∝ P^−a, in a divider of vref_v"
    add("--power-law", dest="pieces", action="store_const", const=POWER_LAW, help=text)
    add("--allow-missing", action="store_true", help="accept nodes without a valid curve")
    add("--area-mm2", type=positive, metavar="MM2", help="area that loads given as forces press on")
    units: dict[str, Any] = {"type": lambda text: text.split(","), "default": []}
    add("--units", **units, metavar="N,V,…", help="units of columns whose headings have none")
    add("--node", type=int, help="the only node that is loaded")
    add("--seal", **file, help="accept a calibration file edited by hand")
    add("--compare", type=Path, nargs=2, metavar=("A", "B"), help="tell how much two files differ")
    add = parser.add_argument_group("loads beside a capture").add_argument
    add("--capture", type=Path, metavar="RAW", help="recording made while the loads were applied")
    add("--offset", type=finite, help="device time minus reference time [s] (found by matching)")
    text = "time ignored at the start of each load [s] (2)"
    add("--settle", type=positive, default=2.0, help=text)  # the paper's sensor takes 0.74 s
    add = parser.add_argument_group("loads taken step by step").add_argument
    add("--port", help="pyserial URL of the digitizer")
    add("--baud", type=int, default=BY_NAME["baud"].default, help="baud rate")
    add("--steps", type=_steps, default=(), metavar="0,10,…", help="loads to take one by one [kPa]")
    add("--seconds", type=positive, default=1.0, help="duration of each measurement [s] (1)")
    add("--append", action="store_true", help="add to an existing file of points")
    add_skin_options(parser, "as described by the capture, else the driver's")


def run(arguments: argparse.Namespace) -> int:
    """Fit, take loads, or seal a file; returns the exit code."""
    if arguments.seal:
        print(f"identity={calibration_file.seal_calibration(arguments.seal)}")
        return 0
    if arguments.compare:
        return _compare(*arguments.compare)
    if arguments.update:
        arguments.output = arguments.output or arguments.update
    loads = _checked(arguments)
    known = calibration_file.read_any(arguments.update).made_for if arguments.update else {}
    values = {**known, **given(arguments), **NODE_ORDER}
    if arguments.skin is not None:
        values["skin"] = arguments.skin
    area_m2 = arguments.area_mm2 and arguments.area_mm2 * 1e-6
    if arguments.capture:
        with naming(arguments.capture, CaptureError):
            config = SkinConfig.of(described_parameters(arguments.capture) | values)
        reference = read_reference(loads, config.spec.nodes, area_m2, arguments.units)
        recording, offset_s = _beside_capture(arguments, reference, config)
        points = plateau_points(reference, recording, offset_s, arguments.settle, config.adc)
    else:
        if not arguments.port:
            values["frame_period_ms"] = LONGEST_MS
        config = SkinConfig.of(values)
        if arguments.port and not _take_loads(arguments, loads, config):
            return 1
        points = read_points(
            loads, config.spec.nodes, config.adc.vref_v, area_m2, arguments.units, arguments.node
        )
    return _fit(arguments, config, points)


def _fit(arguments: argparse.Namespace, config: SkinConfig, points: LoadPoints) -> int:
    nodes = config.spec.nodes
    fit = fit_skin(points, nodes, config.adc, arguments.pieces)
    kept = dict[int, PressureCurve]()
    if arguments.update:
        kept.update(
            calibration_file.read_content(arguments.update, nodes, config.adc, config.skin).curves
        )
        loaded = set(points.node.tolist())
        fit = replace(fit, refused={n: why for n, why in fit.refused.items() if n in loaded})
    print(report.describe(fit))
    for warning in report.warnings(fit, config.curve, config.contact.contact_pa):
        print(f"warning: {warning}")
    if advice := report.advice(fit, nodes):
        print(f"advice: {advice}")
    if not fit.curves:
        raise CalibrationError(f"{points.source}: no node has a sound curve; nothing is written")
    if fit.refused and not arguments.allow_missing:
        nodes_without = listed(list(fit.refused), "node")
        raise CalibrationError(
            f"{points.source}: no sound curve for {nodes_without} (see above); nothing is written: "
            "mend the loads, or --allow-missing takes the default curve for them"
        )
    largest_pa, range_pa = float(points.pressure_pa.max()), config.curve.pressure_pa[-1]
    if (reason := calibration_file.out_of_range(largest_pa, range_pa)) and not arguments.force:
        raise CalibrationError(f"{points.source}: {reason}, or write the file with --force")
    calibration = Calibration.of_nodes(kept | fit.curves, config.curve, nodes)
    content = calibration_file.CalibrationContent.of(
        calibration, config.adc, config.skin, points.source
    )
    results = report.results(fit)
    results["identity"] = calibration_file.write_content(arguments.output, content)
    report.draw(fit, arguments.png)
    print(f"written: {arguments.output}, {arguments.png}")
    print(" ".join(f"{key}={value}" for key, value in results.items()))
    return 0


def _compare(path: Path, other_path: Path) -> int:
    one, other = calibration_file.read_any(path), calibration_file.read_any(other_path)
    off_pa = {
        node: report.difference_pa(one.curves[node], other.curves[node])
        for node in sorted(one.curves.keys() & other.curves.keys())
    }
    if not off_pa:
        raise CalibrationError(f"{path} and {other_path}: no node has a curve in both")
    for node in sorted(off_pa, key=lambda node: -off_pa[node])[:WORST]:
        print(f"node {node}: up to {off_pa[node] / 1e3:.3g} kPa")
    only = len(one.curves.keys() ^ other.curves.keys())
    median_pa, most_pa = np.median(list(off_pa.values())), max(off_pa.values())
    print(
        f"compared={len(off_pa)} in_one_only={only} median_kpa={median_pa / 1e3:.4g} "
        f"most_kpa={most_pa / 1e3:.4g}"
    )
    return 0


def _checked(arguments: argparse.Namespace) -> Path:
    """Return the file of loads; refuse options and files that cannot be meant before anything."""
    if arguments.output is None:
        raise CalibrationError("-o is missing: the calibration file to write, or --update")
    if arguments.port and arguments.capture:
        raise CalibrationError("--port and --capture are both given: loads come from one of them")
    for source, names in OPTIONS_OF.items():
        if not getattr(arguments, source):
            refuse_given(arguments, names, f"goes with --{source} only", CalibrationError)
    output, loads = arguments.output, arguments.loads
    if loads is None:
        if not arguments.port:
            raise CalibrationError("which loads? Give a CSV file, or --port to take them now")
        loads = output.with_suffix(".points.csv")
    if arguments.port:
        _check_writable(loads, True)
    force = arguments.force or output == arguments.update
    _check_writable(output, force, loads, arguments.capture)
    arguments.png = arguments.png or output.with_suffix(".png")
    _check_writable(arguments.png, True, loads, arguments.capture, output)
    return Path(loads)


def _check_writable(path: Path, force: bool, *others: Path | None) -> None:
    """Raise CalibrationError where a file cannot be, or would overwrite what is still needed."""
    if any(other is not None and path.resolve() == other.resolve() for other in others):
        raise CalibrationError(f"{path}: would overwrite another file of this command")
    if path.exists() and not path.is_file():
        raise CalibrationError(f"{path}: not a regular file, so it is not overwritten")
    if path.exists() and not force:
        raise CalibrationError(f"{path}: exists already; --force overwrites it")
    if not path.parent.is_dir():
        raise CalibrationError(f"{path}: there is no such folder")


def _beside_capture(
    arguments: argparse.Namespace, reference: Reference, config: SkinConfig
) -> tuple[Recording, float]:
    """Return what the nodes measured, and its time minus the reference's, s."""
    recording = read_recording(arguments.capture, config)
    for note in capture_notes(arguments.capture):
        tell(f"{arguments.capture}: {note}")
    if arguments.offset is not None:
        return recording, float(arguments.offset)
    found = find_offset(reference, recording, config.curve)
    uncertain = f"{found.offset_s:.2f} ± {found.error_s:.2f} s (match {found.match:.3f})"
    print(f"offset of the clocks: {uncertain}")
    return recording, found.offset_s


def read_recording(path: Path, config: SkinConfig) -> Recording:
    """Read what the nodes measured from a capture; config: with taxels in the order of the nodes.

    Raises CaptureError where there is no frame in it.
    """
    pipeline = Pipeline(config)
    times_s, rows = [], []
    for frame in raw_frames(path, pipeline):
        times_s.append(frame.t_middle)
        rows.append(frame.readings.certain_voltage_v)
    if not rows:
        raise CaptureError(f"{path}: {pipeline.problem or 'no frame found'}")
    return Recording(np.array(times_s), np.array(rows))


def _take_loads(arguments: argparse.Namespace, path: Path, config: SkinConfig) -> bool:
    """Take loads from a live skin; returns whether they were not interrupted."""
    nodes = config.spec.nodes
    if arguments.node is not None and not 1 <= arguments.node <= nodes:
        raise CalibrationError(f"--node is {arguments.node}; the skin has nodes 1…{nodes}")
    loaded = range(1, nodes + 1) if arguments.node is None else [arguments.node]
    frames: SimpleQueue[TactileFrame] = SimpleQueue()
    with Driver(config, arguments.port, arguments.baud, frames.put, lambda problem: None) as driver:
        session = LoadSession(driver, frames, config.adc.lsb_v, loaded, arguments.seconds)
        try:
            taken = session.run(path, arguments.steps, arguments.append)
        except KeyboardInterrupt:
            kept = "no load was taken"
            if path.exists():
                kept = f"{path} has the loads taken so far: add to it with "
                kept += "--append, or leave out --port to fit it"
            print(file=sys.stderr)
            tell(f"interrupted; {kept}")
            return False
    print(f"{taken} loads taken, kept in {path}")
    return True


def _steps(text: str) -> tuple[float, ...]:
    try:
        steps = tuple(float(step) for step in text.split(","))
    except ValueError:
        steps = (math.nan,)
    if not all(0 <= step < math.inf for step in steps):
        raise argparse.ArgumentTypeError(f"{text!r}: loads in kPa, as in 0,10,20")
    return steps
