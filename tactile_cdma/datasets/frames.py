# SPDX-License-Identifier: Apache-2.0

"""The frames of one patch, from one or many sources, as rows for a table."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from .episodes import Episode, samples_of
from .progress import Progress
from .samples import (
    NANO,
    Completeness,
    PatchInfo,
    SampleSource,
    SkinFrame,
    check_patches,
    check_same,
    missing_between,
    patches_of,
)


class PatchFrames:
    """Iterates over the frames of one patch in the episodes of all files: number of episode, frame.

    episodes: of a file. from_first_complete: in every file, begin where every taxel in service has
    had a valid reading. left_out: frames before that. missing: frame periods between two frames of
    an episode without one, by the sequence: lost, or not published. patch: that of the first frame,
    from then on. notes: what was odd, complete when all is read. Raises CaptureError where files do
    not fit together, or a patch is never complete.
    """

    def __init__(
        self,
        sources: Sequence[SampleSource],
        name: str,
        episodes: Callable[[SampleSource], Sequence[Episode]],
        progress: Progress,
        from_first_complete: bool = False,
    ) -> None:
        self._sources, self._name, self._progress = sources, name, progress
        self._episodes, self._from_first_complete = episodes, from_first_complete
        self.left_out = self.missing = 0
        self.patch: PatchInfo | None = None
        self.notes: list[str] = []

    def __iter__(self) -> Iterator[tuple[int, SkinFrame]]:
        before = 0
        for source in self._sources:
            check_patches(self._sources[0], source)
            episodes, checked = self._episodes(source), False
            for row in self._of(source, self._own(source)[0], episodes, before):
                if not checked:  # the digitizer of a recording is known from its first frame on
                    (_, patch), checked = self._own(source), True
                    self.patch = self.patch or patch
                    check_same(self.patch, patch, source.path)
                yield row
            if not checked:
                self.notes.append(f"{source.path}: no frame of {self._name} in its episodes")
            before += len(episodes)

    def _own(self, source: SampleSource) -> tuple[str, PatchInfo]:
        """The patch in a file, as far as that was read, and the key of its frames."""
        return next(one for one in patches_of(source.streams).items() if one[1].name == self._name)

    def _of(
        self, source: SampleSource, key: str, episodes: Sequence[Episode], before: int
    ) -> Iterator[tuple[int, SkinFrame]]:
        """Frames of one file; before: number of its first episode."""
        seen, last = Completeness(), (-1, 0, 0)  # number, sequence, stamp
        restarts, restarts_ns = 0, 0
        for sample in samples_of(source, episodes, self._progress):
            frame = sample.value
            if sample.stream != key or not isinstance(frame, SkinFrame):
                continue
            if self._from_first_complete and not seen.is_complete:
                seen.take(frame)
                if not seen.is_complete:
                    self.left_out += 1
                    continue
            for number, episode in enumerate(episodes):
                if episode.begin_ns <= sample.stamp_ns <= episode.end_ns:
                    if last[0] == number:
                        if (missing := missing_between(last[1], frame.sequence)) is None:
                            restarts += 1
                            restarts_ns += sample.stamp_ns - last[2]
                        self.missing += missing or 0
                    last = (number, frame.sequence, sample.stamp_ns)
                    yield before + number, frame
                    break
        if restarts:
            self.notes.append(
                f"{source.path}: {self._name}: {restarts} where the sequence begins anew (did the "
                f"driver restart?); what is missing in the {restarts_ns / NANO:.3f} s between "
                "these frames is not known"
            )
        if self._from_first_complete:
            seen.check(source.path, self._name)


def paths_of(output: Path, names: Sequence[str]) -> dict[str, Path]:
    """The file of every patch: OUT.npz, or OUT.left_palm.npz, … where there are several."""
    if len(names) == 1:
        return {names[0]: output}
    return {name: output.with_name(f"{output.stem}.{name}{output.suffix}") for name in names}
