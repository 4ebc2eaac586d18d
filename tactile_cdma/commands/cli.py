# SPDX-License-Identifier: Apache-2.0

"""The command `tactile-cdma`: decode, record, simulate, set up hardware; all without ROS."""

from __future__ import annotations

import argparse
import io
import json
import shlex
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .. import __version__
from ..base.errors import CaptureError, SpecError, TactileError
from ..base.interrupt import stop_event
from ..calibrating import command as calibrate
from ..config.arguments import add_skin_options, given, positive
from ..config.parameters import BY_NAME, GAP, SIMULATION
from ..config.skin_config import SkinConfig
from ..doctor import command as doctor
from ..driver.pipeline import Pipeline
from ..hardware.amplifier import design
from ..hardware.node_memory import MCUS, check_timing, describe_memory, node_memory, usual_heartbeat
from ..hardware.programmer import avrdude, burn, node_files, read_memory, write_memory
from ..recording.capture import capture_notes, is_text, read_scope_csv
from ..recording.offline import decode_raw, decode_scope, describe_frame, offline_values
from ..sim import sensor_report
from ..sim.digitizer import VirtualDigitizer
from ..sim.options import SimOptions
from ..sim.pty import serve
from . import export as export_command
from . import layout as layout_command
from . import ports as ports_command
from . import recording as recording_command
from .amplifier_report import describe, report

INTERRUPTED = 128 + signal.SIGINT
"""The exit code that shells know."""
ALL = "all"
"""Instead of a node's number."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal of another alphabet, odd file names
        sys.stdout.reconfigure(errors="backslashreplace")
    arguments = _parser().parse_args(argv)
    try:
        code: int = arguments.run(arguments)
        return code
    except TactileError as error:
        print(f"tactile-cdma: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:  # the reader of our output has seen enough
        sys.stderr.close()
        return 0
    except OSError as error:  # a full disk behind our output, a name that no file can have
        print(f"tactile-cdma: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="tactile-cdma", description=__doc__)
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    decode = commands.add_parser("decode", help="decode a recording or an oscilloscope capture")
    decode.add_argument(
        "file",
        type=Path,
        help="recording, raw bytes of a port, or CSV of time in s and voltage in V",
    )
    decode.add_argument("--json", action="store_true", help="one JSON object per frame")
    add_skin_options(decode)
    decode.set_defaults(run=_decode)

    recording_command.add_to(commands)
    export_command.add_to(commands)

    simulate = commands.add_parser("simulate", help="a virtual digitizer behind a real tty")
    simulate.add_argument("--pty", action="store_true", required=True, help="serve on a pty")
    simulate.add_argument("--link", type=Path, help="also make a symbolic link to the tty")
    simulate.add_argument("--seconds", type=positive, help="end after so long; else on Ctrl-C")
    simulate.add_argument(
        "url",
        nargs="?",
        default=SIMULATION,
        help="options as in a port: 'sim://?scene=press&seed=1'",
    )
    simulate.set_defaults(run=_simulate)

    node = commands.add_parser("node", help="what a sensing node's EEPROM has to hold")
    what = node.add_mutually_exclusive_group(required=True)
    what.add_argument("--node", type=_node_number, metavar="NUMBER", help="1, 2, … or all")
    what.add_argument("--read", type=Path, metavar="FILE", help="print what such a file says")
    node.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        help="Intel HEX (.hex, .eep) or bytes (.bin); with all: a directory, made if missing",
    )
    node.add_argument("--mcu", choices=MCUS, default="atmega328p")
    node.add_argument(
        "--threshold",
        type=int,
        default=1,
        help="the node talks while its code is farther than this from rest or from what it sent "
        "last; 0: always [LSB] (1)",
    )
    node.add_argument(
        "--heartbeat", type=int, help="and once in so many frames; 0: never (as many as take 1 s)"
    )
    node.add_argument("--rest", type=int, help="code at rest (learnt after power-up)")
    node.add_argument(
        "--no-discipline",
        action="store_false",
        dest="discipline",
        help="chip times are the node's own, they do not follow the sync edges",
    )
    node.add_argument(
        "--programmer", metavar="NAME", help="also write it to the node, by avrdude: usbasp, …"
    )
    add_skin_options(node, "the driver's")
    node.set_defaults(run=_node)

    amplifier = commands.add_parser("amplifier", help="the parts between nodes and digitizer")
    amplifier.add_argument("--json", action="store_true", help="as one JSON object")
    amplifier.add_argument(
        "--supply", type=float, default=3.3, help="of nodes and amplifier [V] (3.3)"
    )
    amplifier.add_argument(
        "--adc-volts", type=float, default=3.3, help="range of the digitizer's converter [V] (3.3)"
    )
    amplifier.add_argument("--adc-bits", type=int, default=12, help="its resolution [bit] (12)")
    amplifier.add_argument(
        "--active", type=float, default=1.0, help="largest share of nodes that talk at once (1)"
    )
    add_skin_options(amplifier, "the driver's; the frame period plays no part")
    amplifier.set_defaults(run=_amplifier)

    ports_command.add_to(commands)
    doctor.add_to(commands)
    layout_command.add_to(commands)
    calibrate.add_to(commands)
    sensor_report.add_to(commands)
    return parser


def _node_number(text: str) -> int | str:
    if text != ALL and not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor {ALL!r}")
    return text if text == ALL else int(text)


def _decode(arguments: argparse.Namespace) -> int:
    path: Path = arguments.file
    if is_text(path):
        asked = {"amplitude_mv": 0.0, **given(arguments)}
        if asked.get("timing", GAP) != GAP:
            raise SpecError(
                "an oscilloscope capture holds nothing but the waveform: use --timing gap"
            )
        # Only a digitizer integrates chips; the capture's own rate is what counts here.
        asked |= {"timing": GAP, "samples_per_chip": BY_NAME["samples_per_chip"].default}
        config = SkinConfig.of(asked)
        capture = read_scope_csv(path)
        for note in capture.notes:
            print(f"tactile-cdma: {path}: {note}", file=sys.stderr)
        frames = decode_scope(capture, config)
        pipeline = None
    else:
        config = SkinConfig.of(offline_values(path, given(arguments)))
        pipeline = Pipeline(config, background=False)
        frames = decode_raw(path, pipeline)
        for note in capture_notes(path):
            print(f"tactile-cdma: {path}: {note}", file=sys.stderr)
    count = 0
    for t_start, words in frames:
        count += 1
        frame = describe_frame(t_start, words, config)
        print(json.dumps(frame) if arguments.json else _line(frame), flush=arguments.json)
    return _conclude(path, count, pipeline)


def _line(frame: dict[str, Any]) -> str:
    return f"{frame['t']:.6f} s  {'  '.join(map(_word, frame['nodes'])) or 'all silent'}"


def _word(node: dict[str, Any]) -> str:
    doubt = ", doubtful" if node["doubtful"] else ""
    return (
        f"{node['node']}: {node['bits']} {node['voltage']:.2f} V "
        f"{node['pressure_pa'] / 1e3:.1f} kPa ({node['snr_db']:.0f} dB{doubt})"
    )


def _conclude(path: Path, frames: int, pipeline: Pipeline | None) -> int:
    """Say on stderr what a capture held, and complain where it held nothing."""
    if pipeline is not None:
        counters, packets = pipeline.counters, pipeline.parser.counters
        print(
            f"frames={frames} lost_frames={counters.lost_frames} packets={packets.packets} "
            f"lost_packets={packets.lost_packets} crc_errors={packets.crc_errors} "
            f"rejected={pipeline.rejected}",
            file=sys.stderr,
        )
    if not frames:
        reason = (pipeline.problem if pipeline else None) or (
            "no frame found: check chip duration, order, bits and the frame period"
        )
        raise CaptureError(f"{path}: {reason}")
    return 0


def _simulate(arguments: argparse.Namespace) -> int:
    options = SimOptions.from_url(arguments.url)
    with stop_event(arguments.seconds) as stop:
        serve(
            lambda: VirtualDigitizer(options),
            arguments.link,
            stop,
            lambda path: print(f"serving on {path}", flush=True),
        )
    return 0


def _node(arguments: argparse.Namespace) -> int:
    if arguments.read:
        print(describe_memory(*read_memory(arguments.read)))
        return 0
    output, mcu, programmer = arguments.output, arguments.mcu, arguments.programmer
    if output is None:
        raise SpecError("-o is missing: the file to write, or with --node all the directory")
    if programmer and arguments.node == ALL:
        raise SpecError("--programmer writes one node, the one that is connected: --node is all")
    config = SkinConfig.of(given(arguments))
    check_timing(config.timing)
    nodes = range(1, config.spec.nodes + 1) if arguments.node == ALL else [arguments.node]
    memories = [
        node_memory(
            config.spec,
            node,
            threshold=arguments.threshold,
            heartbeat=arguments.heartbeat,
            rest=arguments.rest,
            discipline=arguments.discipline,
            mcu=mcu,
        )
        for node in nodes
    ]
    paths = [output] if arguments.node != ALL else node_files(output, len(memories))
    for path, memory in zip(paths, memories, strict=True):
        write_memory(path, memory)
    _warn_of_silence(arguments, config)
    print(f"written: {paths[0]}" + (f" … {paths[-1]}" if len(paths) > 1 else ""))
    if programmer:
        burn(output, mcu, programmer)
    else:
        print("to the node:", shlex.join(avrdude(paths[0], mcu, "usbasp")))
    return 0


def _warn_of_silence(arguments: argparse.Namespace, config: SkinConfig) -> None:
    """Nodes that say too little are stale to the driver that has these parameters."""
    heartbeat = arguments.heartbeat
    if heartbeat is None:
        heartbeat = usual_heartbeat(config.spec.frame_period_s)
    silent_s = heartbeat * config.spec.frame_period_s
    if arguments.threshold and not 0 < silent_s < config.stale_after_s:
        often = f"only every {silent_s:g} s" if silent_s else "never"
        print(
            f"tactile-cdma: with heartbeat {heartbeat} a node at rest talks {often}, but "
            f"is stale to the driver after {config.stale_after_s:g} s (stale_after_s)",
            file=sys.stderr,
        )


def _amplifier(arguments: argparse.Namespace) -> int:
    longest_ms = 1e5  # or the default period would refuse larger skins
    config = SkinConfig.of({**given(arguments), "frame_period_ms": longest_ms})
    front = design(
        config.spec,
        config.samples_per_chip,
        supply_v=arguments.supply,
        adc_volts=arguments.adc_volts,
        adc_bits=arguments.adc_bits,
        active=arguments.active,
    )
    if arguments.json:
        print(json.dumps(report(config.spec, front)))
    else:
        print(describe(config.spec, front))
    return 0


if __name__ == "__main__":
    sys.exit(main())
