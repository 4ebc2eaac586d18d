# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma export`: writes frames of recordings and bags for other programs."""

import argparse
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from ..base.errors import CaptureError, ParameterError, needed_for
from ..base.interrupt import terminable
from ..base.named_file import naming
from ..base.program import tell
from ..config.arguments import add_skin_options, finite, given, positive, refuse_given
from ..config.parameters import BY_NAME
from ..datasets.alignment import HOLD, KEEP, MODES, POLICIES, WINDOW
from ..datasets.episodes import Episode, find_episodes, parse_interval
from ..datasets.formats import ON_CLOCK, PICTURES, TableWriter, writer_of
from ..datasets.lerobot import INFO
from ..datasets.lerobot.export import Plan, write_dataset
from ..datasets.lerobot.writer import lerobot_writer
from ..datasets.progress import Progress
from ..datasets.samples import PatchInfo, SampleSource, patches_of
from ..datasets.sources.opening import Wanted, has_times, is_bag, open_source
from ..datasets.sources.recording_source import RecordingSource
from ..datasets.tables import PatchFrames, files_beside

_CHOICES = ("topic", "info", "start", "end", "episode", "marks", "from_first_complete")
_OF_CLOCK = ("fps", "clock", "samples", "nan", "image", "state", "action", "task")
"""Options that not every output has, by their destination."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    add = parser.add_argument
    add("files", type=Path, nargs="+", metavar="FILE", help="recordings, raw bytes, or bags")
    out: dict[str, Any] = {"type": Path, "metavar": "OUT"}
    outputs = parser.add_mutually_exclusive_group(required=True)
    text = (
        "OUT.npz: numpy arrays; OUT.csv: a row per frame, and OUT.taxels.csv, OUT.about.json; "
        "OUT.parquet; OUT.hdf5 (robomimic); OUT.zarr; plot: OUT.pdf, …. Many patches: OUT.PATCH.npz"
    )
    outputs.add_argument("-o", "--output", **out, help=text)
    text = "OUT.mp4 or OUT.gif: the heatmap in real time (the same as -o)"
    outputs.add_argument("--video", dest="output", **out, help=text)
    outputs.add_argument("--lerobot", **out, help="a new folder: a LeRobotDataset v3")
    text = "OUT is a new folder: a bag (MCAP) of tactile and info"
    add("--bag", action="store_true", help=text)
    add("--max-kpa", type=positive, help="pressure at the top of the colour scale of pictures")
    add("--force", action="store_true", help="overwrite existing files")
    add = parser.add_argument_group("what to export").add_argument
    several: dict[str, Any] = {"action": "append", "default": []}
    add("--topic", **several, help="topic of a bag; may be repeated (all)")
    add("--info", type=Path, metavar="BAG", help="take ~/info from here if the bag has none")
    add("--start", type=finite, metavar="S", help="first moment, s from each file's beginning")
    add("--end", type=finite, metavar="S", help="last moment, s from each file's beginning")
    text = "an episode, s from each file's beginning; may be repeated (each file is one)"
    add("--episode", **several, metavar="START:END", help=text)
    add("--marks", metavar="TOPIC", help="topic (Bool, String, Empty) that tells episodes")
    text = "leave out frames from before every taxel has had a valid reading"
    add("--from-first-complete", action="store_true", help=text)
    group = parser.add_argument_group("with --lerobot, and *.hdf5 and *.zarr on one clock")
    clock = group.add_mutually_exclusive_group()
    clock.add_argument("--fps", type=finite, metavar="N", help="rows per second, evenly apart")
    clock.add_argument("--clock", metavar="TOPIC", help="one row per message, as of a camera")
    add = group.add_argument
    text = f"frames per row: all since the last row, or only the newest ({WINDOW})"
    add("--samples", choices=MODES, help=text)
    text = (
        "taxels without a reading: hold the last one, write 0, drop the row, or keep NaN (*.hdf5, "
        f"*.zarr: {KEEP}; else {HOLD})"
    )
    add("--nan", choices=(*POLICIES, KEEP), help=text)
    add("--image", action="append", metavar="TOPIC", help="a camera; may be repeated (all)")
    vector: dict[str, Any] = {"action": "append", "default": [], "metavar": "TOPIC[:NAME,…]"}
    for name, column in (("--state", "observation.state"), ("--action", "action")):
        text = f"{column}: joints, or an array; all, or those named; may be repeated"
        add(name, **vector, help=text)
    add("--task", help="description of the task, in words")
    add_skin_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Read and write; returns the exit code."""
    with terminable(), Progress() as progress:
        _check(arguments)
        has_clock, output = (arguments.fps, arguments.clock) != (None, None), arguments.output
        # Else a file has the skin's own frames.
        is_on_clock = has_clock and output is not None and output.suffix in ON_CLOCK
        if arguments.lerobot is not None or is_on_clock:
            return _dataset(arguments, progress)
        if arguments.bag:
            return _bag(arguments)
        return _tables(arguments, progress)


def _check(arguments: argparse.Namespace) -> None:
    if arguments.lerobot is not None and arguments.bag:
        raise ParameterError("--bag and --lerobot are two outputs: ask for one")
    if arguments.episode and arguments.marks is not None:
        raise ParameterError("--episode and --marks both say where episodes are: ask for one")
    if None not in (arguments.start, arguments.end) and arguments.start >= arguments.end:
        word = "is" if arguments.start == arguments.end else "is after"
        raise ParameterError(f"--start {arguments.start:g} {word} --end {arguments.end:g}")
    try:
        (arguments.task or "").encode()
    except UnicodeEncodeError:
        raise ParameterError("--task is not UTF-8: no program could read it back") from None


def _dataset(arguments: argparse.Namespace, progress: Progress) -> int:
    is_lerobot = arguments.lerobot is not None
    output: Path = arguments.lerobot if is_lerobot else arguments.output
    open_writer = lerobot_writer if is_lerobot else ON_CLOCK[output.suffix]
    if is_lerobot and arguments.nan == KEEP:
        raise ParameterError(f"--nan {KEEP} is not for --lerobot, whose statistics take no NaN")
    if arguments.fps is None and arguments.clock is None:
        raise ParameterError("--lerobot needs --fps N, or --clock with the topic of a camera")
    fps = arguments.fps and int(arguments.fps)
    if fps is not None and not (1 <= fps <= 1000 and fps == arguments.fps):
        raise ParameterError(
            f"--fps is {arguments.fps:g}; it must be a whole number of 1…1000, as LeRobot wants it "
            "(--clock takes the times of a camera of any rate)"
        )
    if output.exists() and not (arguments.force and (not is_lerobot or (output / INFO).is_file())):
        raise CaptureError(f"{output}: exists already; --force replaces a dataset, nothing else")
    plan = Plan(
        episodes=_episodes(arguments, arguments.task or "unnamed"),
        fps=fps,
        clock=arguments.clock,
        mode=arguments.samples or WINDOW,
        policy=arguments.nan or (HOLD if is_lerobot else KEEP),
        from_first_complete=arguments.from_first_complete,
    )
    wanted = Wanted(
        given(arguments),
        arguments.topic,
        derived=True,
        cameras=arguments.image,
        state=arguments.state,
        action=arguments.action,
        info=arguments.info,
    )
    with naming(output, CaptureError):
        outcome = write_dataset(output, arguments.files, wanted, plan, progress, open_writer)
    for reason, rows in outcome.left_out.items():
        outcome.notes.append(f"{rows} rows are left out: {reason}")
    for stream, late in outcome.late.items():
        if late:
            outcome.notes.append(f"{stream}: {late} messages came after their row was written")
    _tell(outcome.notes)
    print(
        f"episodes={outcome.episodes} frames={outcome.frames} fps={outcome.fps} "
        f"left_out={outcome.left_out.total()} {'folder' if is_lerobot else 'file'}={output}"
    )
    return 0


def _episodes(
    arguments: argparse.Namespace, task: str
) -> Callable[[SampleSource], Sequence[Episode]]:
    return partial(
        find_episodes,
        task=task,
        intervals=[parse_interval(text) for text in arguments.episode],
        marks=arguments.marks,
        start_s=arguments.start,
        end_s=arguments.end,
    )


def _tables(arguments: argparse.Namespace, progress: Progress) -> int:
    output: Path = arguments.output
    reason = "goes with --lerobot, *.hdf5 or *.zarr: other tables have the skin's own frames"
    if output.suffix in ON_CLOCK:
        reason = "needs --fps or --clock beside it: else rows are the skin's own frames"
    refuse_given(arguments, _OF_CLOCK, reason)
    writer = writer_of(output)
    if arguments.max_kpa is not None:
        if output.suffix not in PICTURES:
            raise ParameterError(f"--max-kpa is for pictures: {', '.join(PICTURES)}")
        writer = partial(PICTURES[output.suffix], max_pa=arguments.max_kpa * 1e3)
    sources = [
        open_source(path, Wanted(given(arguments), arguments.topic, info=arguments.info))
        for path in arguments.files
    ]
    names = [patch.name for patch in patches_of(sources[0].streams).values()]
    if not names:
        raise CaptureError(f"{arguments.files[0]}: no frames of a skin in this bag")
    paths = {name: output.with_name(f"{output.stem}.{name}{output.suffix}") for name in names}
    if len(names) == 1:
        paths = {names[0]: output}
    for path in paths.values():
        beside = files_beside(path) if path.suffix == ".csv" else ()
        for file in [path, *beside]:
            if file.exists() and not arguments.force:
                raise CaptureError(f"{file}: exists already; --force overwrites it")
    episodes = _episodes(arguments, "")
    # Nothing tells whether a frame that a bag does not hold was lost or, as idle, not published.
    missing = "missing" if any(map(is_bag, arguments.files)) else "lost"
    notes: list[str] = []
    for name, path in paths.items():
        frames = PatchFrames(sources, name, episodes, progress, arguments.from_first_complete)
        taxels = len(_write(frames, sources, path, writer))
        patch = "" if len(names) == 1 else f"patch={name} "
        left_out = f" left_out={frames.left_out}" if arguments.from_first_complete else ""
        print(
            f"{patch}frames={frames.given} {missing}_frames={frames.missing} "
            f"taxels={taxels}{left_out} file={path}"
        )
        notes += frames.notes
        notes += [f"{source.path}: {note}" for source in sources for note in source.notes]
    _tell(notes)
    return 0


def _write(
    frames: PatchFrames, sources: Sequence[SampleSource], path: Path, writer: TableWriter
) -> PatchInfo:
    """Write one patch; returns it. Raises CaptureError for no frame."""
    with naming(path, CaptureError):
        rows = iter(frames)
        if (first := next(rows, None)) is None or (patch := frames.patch) is None:
            raise CaptureError(f"{sources[0].path}: {sources[0].problem or 'no frame found'}")
        about = dict(patch.about)
        if len(sources) > 1:
            about["files"] = [source.path.name for source in sources]
        writer(path, chain([first], rows), patch, about)
    return patch


def _bag(arguments: argparse.Namespace) -> int:
    with needed_for("--bag", "rosbags"):
        from ..recording.bag_export import write_bag  # slow to load, and needed here only

    output: Path = arguments.output
    if output is None or len(arguments.files) > 1:
        raise ParameterError("--bag makes one folder, -o OUT, from one recording")
    refuse_given(arguments, _CHOICES, "does not go with --bag, which writes all of a recording")
    refuse_given(arguments, _OF_CLOCK, "goes with --lerobot, not with --bag")
    [path] = arguments.files
    if is_bag(path):
        raise CaptureError(f"{path}: is a bag already")
    source = RecordingSource(path, given(arguments), derived=False)
    if not has_times(path):
        raise CaptureError(f"{path}: bytes alone have no times, which a bag needs")
    capture = source.capture
    frames = capture.timed_frames()
    if (first := next(frames, None)) is None:
        raise CaptureError(f"{path}: {source.problem or 'no frame found'}")
    frame_id = str(capture.values.get("frame_id", BY_NAME["frame_id"].default))
    with naming(output, CaptureError):
        count = write_bag(output, chain([first], frames), capture.config, capture.source, frame_id)
    lost, taxels = capture.pipeline.counters.lost_frames, len(capture.config.layout.nodes)
    print(f"frames={count} lost_frames={lost} taxels={taxels} folder={output}")
    _tell(f"{path}: {note}" for note in source.notes)
    return 0


def _tell(notes: Iterable[str]) -> None:
    for note in dict.fromkeys(notes):
        tell(note)
