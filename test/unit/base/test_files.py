# SPDX-License-Identifier: Apache-2.0

"""Files: which are read, replaced as a whole, or refused as odd, too large, or making too much."""

import json
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.base.errors import CaptureError, LayoutError, ParameterError, TactileError
from tactile_cdma.base.named_file import existing, expanded, open_named, read_named
from tactile_cdma.base.whole_file import replace_file, replacing, whole_folder
from tactile_cdma.calibrating.load_points import read_table
from tactile_cdma.config.body_file import read_body
from tactile_cdma.config.parameters import read_file
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.places.surface_file import read_link, read_triangles
from tactile_cdma.recording.recording_file import is_text, read_bytes
from tactile_cdma.recording.scope_csv import MOST_SAMPLES, read_scope_csv
from test.support.bounds import bounded, room
from test.support.programs import run_python
from torture.files.campaign import ODD, SPARSE_BYTES, cut_when_looked_at
from torture.files.readers import READERS, placed, session


def test_a_file_is_read_up_to_its_limit(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"x" * (1 << 20))
    assert len(read_named(path, 1 << 20)) == 1 << 20
    with path.open("ab") as file:
        file.write(b"x")
    with pytest.raises(OSError, match="has 1048577 bytes; files of this kind have 1048576 at most"):
        read_named(path, 1 << 20)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("a\0b", "no file can have this name"),
        ("a\ud800", "no file can have this name"),
        ("none", "No such file"),
    ],
)
def test_names_that_no_file_has_are_refused(tmp_path: Path, name: str, why: str) -> None:
    with pytest.raises(OSError, match=why):
        open_named(tmp_path / name)


def test_paths_of_users_begin_in_the_home_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    assert expanded("~/skin.yaml") == Path("/home/somebody/skin.yaml")
    assert expanded("skin.yaml") == Path("skin.yaml")
    for text, reason in (("~nobody-of-this-name/a", "the user after"), ("~\0", "no file can have")):
        with pytest.raises(ValueError, match=reason):
            expanded(text)


def test_paths_may_be_urls_of_robots(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "install" / "share" / "my_hand").mkdir(parents=True)
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/opt/ros/none{os.pathsep}{tmp_path / 'install'}")
    share = tmp_path / "install" / "share" / "my_hand"
    assert expanded("package://my_hand/layouts/palm.yaml") == share / "layouts" / "palm.yaml"
    assert expanded(f"file://{tmp_path}/palm.yaml") == tmp_path / "palm.yaml"
    with pytest.raises(ValueError, match="no package 'my_arm' in AMENT_PREFIX_PATH: is it built"):
        expanded("package://my_arm/palm.yaml")
    with pytest.raises(ValueError, match="package:// or file://, but not with https://"):
        expanded("https://host/palm.yaml")


def test_a_missing_file_is_told_with_the_one_that_was_meant(tmp_path: Path) -> None:
    (tmp_path / "my_skin.yaml").write_text("")
    for path, meant in (
        (tmp_path / "my_skn.yaml", "; did you mean .*my_skin.yaml"),
        (tmp_path / "wired_skin.yaml", "; did you mean .*/config/wired_skin.yaml"),
        (tmp_path / "skn_my.yaml", "skn_my.yaml$"),  # only its ending is like the other's
        (tmp_path / "void" / "x.yaml", "x.yaml$"),
    ):
        with pytest.raises(ParameterError, match=meant):
            existing(path)


def test_a_file_is_made_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    for text in ("first, of two lines\nµ\n", "second\n"):
        replace_file(path, text)
        assert path.read_text(encoding="utf-8") == text
        assert path.stat().st_mode & 0o777 == 0o644
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_a_new_file_has_the_permissions_of_the_umask(tmp_path: Path, umask: int, mode: int) -> None:
    path, before = tmp_path / "file.txt", os.umask(umask)
    try:
        replace_file(path, "text")
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == mode


def test_a_private_file_stays_private_and_a_link_a_link(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    path.chmod(0o600)
    with replacing(path) as file:
        file.write(b"new")
        assert all(each.stat().st_mode & 0o777 == 0o600 for each in tmp_path.iterdir())
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o600
    target, link = tmp_path / "palm.yaml", tmp_path / "current.yaml"
    target.write_text("old")
    link.symlink_to(target)
    replace_file(link, "new")
    assert link.is_symlink() and target.read_text() == "new"


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")

    def fail(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(OSError, match="No space left"):
        replace_file(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_beyond_the_size_limit_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    program = (
        "import resource, sys; from pathlib import Path;"
        "from tactile_cdma.base.whole_file import replace_file;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100));"
        "replace_file(Path(sys.argv[1]), 'x' * 200)"
    )
    done = run_python("-c", program, path)
    assert "OSError: [Errno 27] File too large" in done.stderr
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_into_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    link = tmp_path / "table.csv"
    link.symlink_to(tmp_path / "gone" / "table.csv")
    with pytest.raises(OSError, match=r"links to .*/gone/table\.csv, whose folder does not exist"):
        replace_file(link, "text")
    with pytest.raises(OSError, match="whose folder does not exist"), whole_folder(link):
        pass


def test_what_killed_writers_leave_goes_with_the_next_write(tmp_path: Path) -> None:
    """But not what another one is writing now, nor what only looks alike."""
    pytest.importorskip("fcntl", reason="Windows itself keeps what is open")
    path = tmp_path / "skin[1].yaml"
    replace_file(path, "first")
    program = (
        "import os, sys; from pathlib import Path;"
        "from tactile_cdma.base.whole_file import replacing\n"
        "with replacing(Path(sys.argv[1])) as file:\n"
        "    file.write(b'half'); file.flush(); os.kill(os.getpid(), 9)"
    )
    for _ in range(2):
        run_python("-c", program, path)
    (tmp_path / ".skin[1].yaml.backup").write_text("precious")
    [left] = tmp_path.glob(".skin*.????????")
    assert path.read_text() == "first"
    with replacing(path) as file:
        file.write(b"second")
        assert not left.exists()
        replace_file(path, "meanwhile")
    assert path.read_text() == "second"
    assert {each.name for each in tmp_path.iterdir()} == {path.name, ".skin[1].yaml.backup"}


@pytest.mark.parametrize("write", ["file", "folder"])
def test_names_are_on_disk_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: str
) -> None:
    synced, fsync = [], os.fsync

    def note(descriptor: int) -> None:
        synced.append(Path(os.readlink(f"/proc/self/fd/{descriptor}")))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", note)
    if write == "file":
        replace_file(tmp_path / "file.txt", "text")
    else:
        with whole_folder(tmp_path / "folder"):
            pass
    assert synced[-1] == tmp_path


def test_a_missing_folder_and_what_is_no_file_are_errors(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        replace_file(tmp_path / "none" / "file.txt", "new")
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, tmp_path):
        with pytest.raises(OSError, match="not a file"):
            replace_file(path, "text")
    assert pipe.is_fifo()


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    with whole_folder(folder) as unfinished:
        (unfinished / "one").write_text("1")
        assert not folder.exists()
    with pytest.raises(KeyboardInterrupt), whole_folder(folder) as unfinished:
        (unfinished / "two").write_text("2")
        raise KeyboardInterrupt
    assert [path.name for path in tmp_path.rglob("*")] == ["data", "one"]
    with whole_folder(folder) as unfinished:
        (unfinished / "two").write_text("2")
    assert [path.name for path in tmp_path.rglob("*")] == ["data", "two"]
    with pytest.raises(FileNotFoundError), whole_folder(folder) as unfinished:
        shutil.rmtree(unfinished)  # by somebody else: what was there has been moved away by then
    assert [path.name for path in tmp_path.rglob("*")] == ["data", "two"]


def test_a_link_keeps_pointing_to_the_replaced_folder(tmp_path: Path) -> None:
    real, link = tmp_path / "real" / "set", tmp_path / "link"
    real.mkdir(parents=True)
    (real / "old").touch()
    link.symlink_to(real)
    with whole_folder(link) as unfinished:
        (unfinished / "new").touch()
    assert link.is_symlink() and sorted(tmp_path.iterdir()) == [link, real.parent]
    assert list(real.parent.iterdir()) == [real] and list(real.iterdir()) == [real / "new"]


BAGS = {"mcap", "sqlite", "metadata"}
"""What another library reads, in words of its own where it is damaged."""
OURS = [reader for reader in READERS if reader not in BAGS]


def refused(reader: str, folder: Path, make: Callable[[Path], object]) -> str:
    """Return how a reader refuses what make puts in its file's place."""
    path = placed(READERS[reader], folder, make)
    with bounded(), pytest.raises(TactileError) as caught:
        READERS[reader].read(path)
    assert path.name in str(caught.value) or path.parent.name in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("reader", OURS)
@pytest.mark.parametrize("odd", ["a pipe", "/dev/zero", "a socket", "a folder"])
def test_what_is_no_file_is_named_as_such(tmp_path: Path, reader: str, odd: str) -> None:
    """Without waiting for anything to come of it."""
    make = partial(ODD[odd], reader=READERS[reader])
    kind = odd.replace("/dev/zero", "a device")
    assert f"is {kind}, not a file" in refused(reader, tmp_path, make)


@pytest.mark.parametrize("reader", [each for each in OURS if each not in {"session"}])
def test_an_empty_file_is_refused(tmp_path: Path, reader: str) -> None:
    refused(reader, tmp_path, Path.touch)


@pytest.mark.parametrize("reader", [each for each in OURS if each not in {"capture"}])
def test_4_gib_are_refused_in_bounded_time_and_memory(tmp_path: Path, reader: str) -> None:
    said = refused(reader, tmp_path, lambda path: (path.touch(), os.truncate(path, SPARSE_BYTES)))
    streamed = "not a recording" in said
    assert streamed or f"has {SPARSE_BYTES} bytes; files of this kind have" in said


def test_what_is_read_piece_by_piece_has_no_limit(tmp_path: Path) -> None:
    path = tmp_path / "capture.bin"
    path.touch()
    os.truncate(path, SPARSE_BYTES)
    with bounded():
        assert is_text(path) is False
        assert next(read_bytes(path))[0].count(0) == 1 << 16


@pytest.mark.parametrize(
    "reader", [each for each in OURS if each not in {"recording", "description", "capture"}]
)
def test_a_file_that_shrinks_while_it_is_read_is_not_taken_for_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str
) -> None:
    monkeypatch.setattr(os, "fstat", os.fstat)  # which is replaced for this test
    cut_when_looked_at(tmp_path / READERS[reader].name)
    said = refused(reader, tmp_path, lambda path: path.write_text("node,pressure\n" * 64))
    assert "changed while they were read" in said


def test_parameter_files_of_ros_are_files(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=f"{tmp_path.name}: not a file"):
        existing(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ParameterError, match="pipe: not a file"):
        existing(tmp_path / "pipe")


def test_a_pipe_beside_a_file_hinders_nobody_who_writes_it(tmp_path: Path) -> None:
    """As a writer looks for what killed writers have left, some names could be anybody's."""
    pipe = tmp_path / ".table.csv.01234567"
    os.mkfifo(pipe)
    with bounded():
        replace_file(tmp_path / "table.csv", "text")
    assert (tmp_path / "table.csv").read_text() == "text" and pipe.is_fifo()


@pytest.mark.parametrize(("encoding", "named"), [("utf-16", "UTF-16"), ("latin-1", "Latin-1")])
def test_another_encoding_is_named(tmp_path: Path, encoding: str, named: str) -> None:
    path = tmp_path / "file"
    path.write_bytes("node,pressure_kpa,voltage_v\n# 20 °C\n1,2,3\n".encode(encoding))
    for read in (read_table, read_file, session):
        with pytest.raises(TactileError, match=f"UTF-8, but in {named}"):
            read(path)
    path.write_bytes("node,pressure_kpa,voltage_v\n1,2,3\n".encode("utf-8-sig"))
    assert np.allclose(read_table(path).columns["pressure"], 2000)


MESH = """schema: tactile_cdma/layout
version: 1
shape: mesh
mesh: part.stl
pitch_mm: 1
at_mm: [0, 0, 0]
out: [0, 0, 1]
right: [1, 0, 0]
"""
SPHERE = '<collision><geometry><sphere radius="0.01"/></geometry></collision>'


def layout(path: Path) -> None:
    read_layout(path, Wiring())


def stl(triangles: np.ndarray) -> bytes:
    """Write triangles (n, 3, 3) as binary STL."""
    facets = np.zeros(len(triangles), dtype=[("of", "<f4", 12), ("no", "<u2")])
    facets["of"][:, 3:] = triangles.reshape(-1, 9)
    return bytes(80) + len(triangles).to_bytes(4, "little") + facets.tobytes()


def ball(taxels: int) -> str:
    """List taxels in a ball, a quarter of the pitch that the file says apart."""
    places = np.random.default_rng(1).normal(size=(taxels, 3)) / 4
    entries = "".join(
        f"- {{position_mm: [{x:.6f}, {y:.6f}, {z:.6f}], node: {i}}}\n"
        for i, (x, y, z) in enumerate(places, 1)
    )
    head = "schema: tactile_cdma/layout\nversion: 1\nshape: list\npitch_mm: 1\ntaxels:\n"
    return head + entries


def repeated(items: object, name: str = "a{}", **parameters: object) -> bytes:
    """Write a body (JSON is YAML) of one patch with these items."""
    patch = {"repeat": items, "parameters": parameters}
    return json.dumps({"frame_id": "body", "patches": {name: patch}}).encode()


LONG = "{}" * 30_000
SECTION = "? " + "/**" * 20_000 + "/x\n: {ros__parameters: {bits: 10}}"
MUCH, MANY = "repeat writes out more than", "more than 524288 triangles"
Content = tuple[bytes | Callable[[], bytes], str]
CASES: dict[tuple[str, Callable[[Path], object]], dict[str, Content]] = {
    ("body.yaml", read_body): {
        "texts": (lambda: repeated([f"{'x' * 120}{i}" for i in range(500)], port=LONG), MUCH),
        "a text": (lambda: repeated(["x" * 60_000], port=LONG), MUCH),
        "a name": (lambda: repeated(["x" * 60_000], name="a" + "{}" * 500), MUCH),
        "lists": (lambda: repeated([f"i{i}" for i in range(1000)], port=[1] * 20_000), MUCH),
        "items": (
            lambda: repeated({f"i{i}": {} for i in range(100_000)}),
            "repeat has 100000 items; the limit is 1000",
        ),
    },
    ("skin.yaml", lambda path: read_file(path, "/a/b/c/d")): {
        "wildcards of a node": (SECTION.encode(), "this node is /a/b/c/d"),
        "sections": (
            lambda: b"".join(
                b"/%s%d: {ros__parameters: {}}\n" % (b"n" * 99, i) for i in range(9999)
            ),
            "and 9979 more, and this node is /a/b/c/d",
        ),
    },
    ("hand.urdf", lambda path: read_link(path, "ball")): {
        "spheres": (f"<robot><link name='ball'>{SPHERE * 10_000}</link></robot>".encode(), MANY),
        "elements": (b"<robot>" + b"<a/>" * 524_000 + b"</robot>", "has no link 'ball'"),
        "links": (
            b"<robot>" + b"".join(b"<link name='%d'/>" % i for i in range(50_000)) + b"</robot>",
            "49980 more",
        ),
    },
    ("part.obj", read_triangles): {
        "corners": (b"v 1 1 1\n" * (2 << 20), MANY),
        "faces": (b"v 1 1 1\n" + b"f 1 1 1\n" * 540_000, MANY),
        "a face": (b"v 1 1 1\nf" + b" 1" * (1 << 20), "a line of 2097153 bytes; the limit is"),
        "empty lines": (b"\n" * (2 << 20), "has no triangles"),
    },
    ("part.stl", read_triangles): {"triangles": (b"vertex 1 1 1\n" * (2 << 20), MANY)},
    ("skin.yaml", layout): {"taxels": (lambda: ball(700).encode(), "taxels lie within 3 pitches")},
}


@pytest.mark.parametrize(
    ("kind", "case"),
    [pytest.param(kind, case, id=f"{case} of {kind[0]}") for kind in CASES for case in CASES[kind]],
)
def test_what_would_make_much_is_refused(
    tmp_path: Path, kind: tuple[str, Callable[[Path], object]], case: str
) -> None:
    (name, read), (content, words) = kind, CASES[kind][case]
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content())
    del content
    with bounded(room(path)), pytest.raises((TactileError, ValueError), match=words) as caught:
        read(path)
    assert name in str(caught.value) or "triangles" in words


def test_triangles_on_top_of_each_other_are_too_many_for_taxels(tmp_path: Path) -> None:
    flat = np.array([[-999, -999, 0], [999, -999, 0], [0, 999, 0.0]])
    (tmp_path / "part.stl").write_bytes(stl(np.tile(flat, (100_000, 1, 1))))
    path = tmp_path / "skin.yaml"
    path.write_text(MESH + "rows: 64\ncolumns: 64\n")
    with bounded(), pytest.raises(LayoutError, match="too many triangles for 4096 taxels"):
        layout(path)


def test_a_fine_mesh_takes_no_longer_for_triangles_that_are_elsewhere(tmp_path: Path) -> None:
    """All pairs of its taxels and triangles would take minutes."""
    side = np.arange(500) / 2.0 - 125
    x, y = (part.ravel() for part in np.meshgrid(side, side))
    near = np.stack([x, y, np.zeros_like(x)], axis=1)
    corners = near[:, None] + np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]])
    halves = near[:, None] + np.array([[0.5, 0, 0], [0.5, 0.5, 0], [0, 0.5, 0]])
    (tmp_path / "part.stl").write_bytes(stl(np.concatenate([corners, halves])))
    path = tmp_path / "skin.yaml"
    path.write_text(MESH + "rows: 32\ncolumns: 32\nscale: 0.001\n")
    with bounded():
        found = read_layout(path, Wiring())
    assert np.allclose(found.positions_m[:, 2], 0, atol=1e-6)
    assert np.allclose(found.normals, [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("read", "heading", "row", "count"),
    [
        (read_table, "pressure_kpa,voltage_v", "1,2", 600_000),
        (lambda path: read_scope_csv(path, rate_hz=1e6), "CH1;CH2", "1;2", 2_000_000),
        (lambda path: read_scope_csv(path, rate_hz=1e6), "", "0.5", 2_000_000),
    ],
)
def test_a_table_of_short_lines_takes_ten_times_its_size_at_most(
    tmp_path: Path, read: Callable[[Path], object], heading: str, row: str, count: int
) -> None:
    """A list of its lines alone would take more."""
    path = tmp_path / "long.csv"
    path.write_text(f"{heading}\n" + f"{row}\n" * count)
    with bounded(room(path)):
        assert read(path)


def test_more_samples_than_fit_into_memory_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "long.csv"
    path.write_bytes(b"1,2\n" * (MOST_SAMPLES + 1))
    with bounded(room(path)), pytest.raises(CaptureError, match="has more than 16777216 samples"):
        read_scope_csv(path)
