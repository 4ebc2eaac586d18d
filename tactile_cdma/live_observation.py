# SPDX-License-Identifier: Apache-2.0

"""Gives a policy what it was trained on: features of an exported dataset, from running skins."""

from __future__ import annotations

import reprlib
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .base.arrays import Floats32
from .base.errors import CaptureError, ObservationError, ParameterError
from .config.parameters import BY_NAME, unknown
from .config.python_arguments import WHOLE_NS, argument, instance, path_of, seconds, unmasked
from .config.skin_config import CURVE_PARAMETERS, FRAME_PARAMETERS
from .datasets.alignment import HOLD, LAST, MOST_UNCERTAIN_S, Present, Tick, TouchStream
from .datasets.lerobot.features import cells, obstacle
from .datasets.lerobot.meta import STATE, DatasetMeta
from .datasets.samples import (
    DERIVED,
    NANO,
    Kind,
    PatchInfo,
    Sample,
    SampleStream,
    SkinFrame,
    check_taxels,
    differences,
    feature_name,
    in_order,
)
from .datasets.sources.recording_source import patch_info, samples_of
from .skin import Frame, Skin

LAG_S = 0.1
"""An observation is as of the moment that every stream has passed, but at most this old, s, or two
frame periods of the slowest skin. Chosen: above what a frame takes from its middle on the wire."""
ROWS_HZ = 30
"""Rows per s of LiveObservation.of: with more than 2, nothing depends on it."""
_READING = (
    *FRAME_PARAMETERS, "chip_us", "sign_seed", "amplitude_mv", "timing", "vref_v", "active_share",
    *sorted(CURVE_PARAMETERS - {"calibration_file"}), "stale_after_s", "drift_pa_per_min",
    "contact_kpa", "release_kpa",
)  # fmt: skip
"""Parameters that readings or contacts depend on; a calibration has its identity."""


class Observation(ABC):
    """The present, as rows of a dataset hold it; subclasses read skins, or topics.

    features: shape and dtype of what read() gives, by name. elements: names of its elements, or of
    its axes. others: the dataset's observations that the program has to add itself, such as images.
    meta: all that is known of the dataset.
    """

    def __init__(self, meta: DatasetMeta, streams: Mapping[str, SampleStream]) -> None:
        """streams: the streams that samples come from, by key."""
        self.meta, self._streams = meta, streams
        self.features = {one.name: (one.shape, np.dtype(one.dtype)) for one in meta.features}
        self.elements = {one.name: one.names for one in meta.features}
        self.others = tuple(meta.others)
        self._lag_ns = round(LAG_S * NANO)
        self._begin()

    def _begin(self) -> None:
        """Begin anew: nothing is known."""
        meta = self.meta
        touch = {
            key: TouchStream(stream.shape[0], meta.slots[stream.feature], meta.mode, meta.policy)
            for key, stream in self._streams.items()
            if stream.kind == Kind.TACTILE
        }
        self._present = Present(self._streams, touch, meta.fps)
        self._begin_ns = self._now_ns()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.meta.path)!r}, {len(self.features)} features)"

    @property
    def notes(self) -> list[str]:
        """Tell how what is found may differ from what the dataset holds, in sentences."""
        return [
            difference
            for name, mine in self.abouts().items()
            if (about := self.meta.about.get(name)) is not None  # else there is no dataset
            for difference in _differences(name, mine, about)
        ]

    @abstractmethod
    def abouts(self) -> dict[str, Mapping[str, Any]]:
        """Return what is known of the skins, by name; see PatchInfo.about."""

    def state(
        self,
        values: ArrayLike | Mapping[str, float],
        names: Sequence[str] = (),
        stamp_ns: int | None = None,
    ) -> None:
        """Take the robot's state, observation.state: call it as often as one is measured.

        values: by name, or in the order of names; without names, in the order of the dataset.
        stamp_ns: Unix time at which it was measured; now, unless it is given. Raises
        ParameterError for other names than the dataset's, another number of values, and NaN.
        """
        if (stream := self._streams.get(key := STATE)) is None:
            raise ParameterError(f"{self.meta.path} has no {key} for a program to give")
        if isinstance(values, Mapping):
            names, values = tuple(values), list(values.values())
        array = _numbers(key, values)
        given = tuple(names) or stream.names
        fits = array.shape == (len(given),) == stream.shape
        if not fits or (found := in_order(array, given, stream.names)) is None:
            raise ParameterError(
                f"{key} has {array.size} values of {', '.join(given)}; the dataset's are "
                f"{', '.join(stream.names)}"
            )
        now_ns = self._now_ns()
        self._present.add(Sample(key, _stamp(stamp_ns, now_ns), now_ns, found))

    def read(self, now: bool = False) -> dict[str, NDArray[Any]]:
        """Observe the present, at once: arrays as the dataset has them, by feature.

        The moment is the newest that all streams have passed, so that nothing of it is still on its
        way, but none older than LAG_S; now: it is the present, as in a recorder's rows. Raises
        ObservationError, with the reason, where the dataset would have no row: a stream has not
        begun, the state is too old, or, with --nan drop, a taxel has no valid reading. PortError
        where it, or a skin, is closed.
        """
        argument("now", now, False)
        self._take_waiting()
        now_ns = self._now_ns()
        passed_ns = min((stamp for stamp, _ in self._present.newest.values()), default=now_ns)
        oldest_ns = now_ns if now else now_ns - self._lag_ns
        return self.at(max(min(now_ns, passed_ns), oldest_ns, self._present.done_ns))

    def at(self, time_ns: int) -> dict[str, NDArray[Any]]:
        """Observe a moment, Unix time, not before the last one; raises as read()."""
        time_ns = argument("time_ns", time_ns, 0, WHOLE_NS, "ns")
        row = self._present.row(Tick(time_ns, 0, self._present.done_ns))
        streams = self._streams.values()
        reason = obstacle(row, streams, self.meta.policy, self._begin_ns, "this run")
        if reason is not None:
            why = "; ".join(self._problems())
            raise ObservationError(f"{reason} ({why})" if why else reason)
        found = cells(row, streams, self.meta.features)
        return {
            name: np.asarray(found[name], dtype=dtype).reshape(shape)
            for name, (shape, dtype) in self.features.items()
        }

    def _add(self, sample: Sample) -> None:
        """Add a sample; a patch begins once it is known when: before, nothing of it is valid."""
        touch, value = f"observation.tactile.{sample.stream.rpartition('.')[2]}", sample.value
        is_sure = isinstance(value, SkinFrame) and not value.stamp_uncertainty_s > MOST_UNCERTAIN_S
        if is_sure or touch in self._present.newest or touch not in self._streams:
            self._present.add(sample)

    def _check_taxels(self, mine: PatchInfo) -> None:
        """Raises CaptureError for a skin whose taxels are not those of the dataset."""
        its = self.meta.patches[mine.name]
        if np.isfinite(its.positions_m).all():  # else the dataset's bag did not say
            check_taxels(mine, its, self.meta.path, "the skin")
        elif len(mine) != len(its):
            raise CaptureError(
                f"{self.meta.path}: {mine.name} has {len(its)} taxels, not {len(mine)}"
            )

    @abstractmethod
    def _now_ns(self) -> int:
        """Return the present Unix time, ns."""

    @abstractmethod
    def _take_waiting(self) -> None:
        """Add what has come; raises PortError where that is closed."""

    @abstractmethod
    def _problems(self) -> Iterator[str]:
        """Tell why nothing comes, as far as that is known."""


class LiveObservation(Observation):
    """The observation of a dataset, feature by feature, by the code that exported it.

        with Skin(port, contacts=True, **LiveObservation.parameters("grasps")) as skin:
            observation = LiveObservation("grasps", skin)
            while True:
                observation.state(joints)
                action = policy(observation.read())

    dataset: a folder that `tactile-cdma export --lerobot` wrote, or what is to be known of one.
    skins: open skins by the name that their patch has in the dataset; one skin where it has one
        patch. Their frames go here: nobody else must read them. contacts=True is needed where the
        dataset has contacts or wrench.
    features, elements, others: see Observation.

    CaptureError: raised for a folder that is no such dataset, and for other taxels than its.
    ParameterError: raised where a skin is missing, is too many, or does not find contacts.
    """

    def __init__(
        self, dataset: str | PathLike[str] | DatasetMeta, skins: Skin | Mapping[str, Skin]
    ) -> None:
        if not isinstance(dataset, DatasetMeta):
            dataset = DatasetMeta.read(path_of("dataset", dataset))
        self._ahead_ns = time.time_ns() - time.monotonic_ns()  # of the monotonic clock
        meta = dataset
        super().__init__(meta, meta.streams)
        self._skins = _by_name(skins, next(iter(meta.slots)))
        if self._skins.keys() != meta.slots.keys():
            names = ", ".join(meta.slots)
            raise ParameterError(
                f"skins are {', '.join(self._skins) or 'none'}; {meta.path} has {names}"
            )
        for name, skin in self._skins.items():
            self._check(name, skin)
        slowest_s = max(skin.config.spec.frame_period_s for skin in self._skins.values())
        self._lag_ns = round(max(LAG_S, 2 * slowest_s) * NANO)

    @classmethod
    def of(cls, skins: Skin | Mapping[str, Skin]) -> LiveObservation:
        """Take what `tactile-cdma export --samples last` would write of these skins for a dataset.

        With contacts and wrench where all find contacts. Names become those of the export.
        """
        by_name = _by_name(skins)
        named = {feature_name(name): skin for name, skin in by_name.items()}
        if not named or len(named) < len(by_name):
            raise ParameterError(
                f"skins are {', '.join(by_name) or 'none'}: these would be {len(named)} patches"
            )
        patches = [patch_info(one.config, one.source, name, {}) for name, one in named.items()]
        contacts = all(one.contacts for one in named.values())
        return cls(DatasetMeta.of(patches, contacts, ROWS_HZ, LAST, HOLD), named)

    @staticmethod
    def parameters(dataset: str | PathLike[str], patch: str = "") -> dict[str, Any]:
        """Return the parameters with which a patch of the dataset was decoded, for Skin.

        patch: its name; not needed where there is one. Raises CaptureError where the export did not
        decode it: a bag does not hold the driver's parameters.
        """
        meta = DatasetMeta.read(path_of("dataset", dataset))
        patch = _known(patch, meta.slots)
        found = meta.about.get(patch, {}).get("parameters")
        if found is None:
            raise CaptureError(f"{dataset}: no parameters of {patch}: was it made from a bag?")
        return {name: value for name, value in found.items() if name in BY_NAME and name != "port"}

    def take(
        self,
        frame: Frame,
        patch: str = "",
        stamp_ns: int | None = None,
        uncertainty_s: float = 0.0,
    ) -> None:
        """Take a frame that the program has read itself; read() does so with all that wait.

        patch: its name in the dataset; not needed where there is one. stamp_ns: Unix time of
        its middle, if that is not t_host, as in a replay, and what it may be off by, s. Raises
        ParameterError for a frame of other taxels.
        """
        patch, frame = _known(patch, self._skins), instance("frame", frame, Frame)
        if not np.array_equal(frame.positions_m, self._skins[patch].layout.positions_m):
            raise ParameterError(f"the frame is not of patch {patch}'s skin")
        if stamp_ns is None:
            uncertainty_s = frame.stamp_uncertainty_s
        uncertainty_s = seconds("uncertainty_s", uncertainty_s)
        stamp_ns = _stamp(stamp_ns, round(frame.t_host * NANO) + self._ahead_ns)
        touch = SkinFrame(
            sequence=frame.sequence,
            device_time_s=frame.t_device,
            wall_time_s=stamp_ns / NANO,
            stamp_uncertainty_s=uncertainty_s,
            noise_v=frame.noise_rms_v,
            pressure_pa=frame.pressure_pa,
            voltage_v=frame.voltage_v,
            status=frame.status,
        )
        keys, now_ns = skin_keys(patch), self._now_ns()
        for sample in samples_of(keys, touch, frame.contacts, stamp_ns, now_ns):
            if sample.stream in self._streams:
                self._add(sample)

    def abouts(self) -> dict[str, Mapping[str, Any]]:
        """Return what is known of the skins, by name; with their parameters."""
        return {
            name: patch_info(
                skin.config,
                skin.source,
                name,
                {"tared": skin.tared, "parameters": dict(skin.parameters)},
            ).about
            for name, skin in self._skins.items()
        }

    def _take_waiting(self) -> None:
        for name, skin in self._skins.items():
            for frame in skin.waiting():
                self.take(frame, name)

    def _problems(self) -> Iterator[str]:
        return (skin.problem for skin in self._skins.values() if skin.problem)

    def _now_ns(self) -> int:
        return time.monotonic_ns() + self._ahead_ns

    def _check(self, name: str, skin: Skin) -> None:
        """Refuse a skin whose taxels are not those of the dataset, or that finds no contacts."""
        self._check_taxels(patch_info(skin.config, skin.source, name, {}))
        if not skin.contacts and not self._streams.keys().isdisjoint(skin_keys(name)[1:]):
            raise ParameterError(
                f"{self.meta.path} has contacts of {name}: open it with Skin(…, contacts=True)"
            )


def skin_keys(patch: str) -> list[str]:
    """Return the columns of a patch's touch, contacts and wrench."""
    return [f"observation.{kind}.{patch}" for kind in (Kind.TACTILE, *DERIVED)]


def _by_name(skins: Skin | Mapping[str, Skin], patch: str = "") -> dict[str, Skin]:
    """Skins by their patches' names; patch: that of a single one, its own if it is empty."""
    if isinstance(skins, Skin):
        return {patch or skins.config.skin: skins}
    return {
        argument("a patch's name", name, ""): instance(f"skins[{name!r}]", skin, Skin)
        for name, skin in instance("skins", skins, Mapping).items()
    }


def _known(patch: str, patches: Iterable[str]) -> str:
    """Return the name of a patch; the first, if it is empty."""
    if (patch := argument("patch", patch, "")) and patch not in patches:
        raise ParameterError(unknown(patch, patches, "patch"))
    return patch or next(iter(patches))


def _numbers(name: str, values: ArrayLike) -> Floats32:
    """Check that values are numbers: one that is none would be taken for what was measured."""
    values, array = unmasked(name, values), None
    with suppress(TypeError, ValueError), np.errstate(over="ignore"):  # it becomes infinite
        found = np.asarray(values)
        array = found.astype(np.float32) if found.dtype.kind in "iuf" else None
    if array is None or not np.isfinite(array).all():
        raise ParameterError(f"{name} is {reprlib.repr(values)}; it must be finite numbers")
    return array


def _stamp(stamp_ns: int | None, otherwise_ns: int) -> int:
    return otherwise_ns if stamp_ns is None else argument("stamp_ns", stamp_ns, 0, WHOLE_NS, "ns")


def _differences(name: str, mine: Mapping[str, Any], its: Mapping[str, Any]) -> Iterator[str]:
    """Tell how what a skin finds may differ from what it found for a dataset, by what is known."""
    yield from differences(name, its, mine, "the dataset")
    asked, then_asked = mine.get("parameters"), its.get("parameters")
    if asked is None or then_asked is None:
        return  # of a bag, or of a driver, which do not say
    for parameter in _READING:
        default = BY_NAME[parameter].default
        now, then = (some.get(parameter, default) for some in (asked, then_asked))
        if now != then:
            yield f"{parameter} of patch {name} is {now!r}, in the dataset {then!r}"
