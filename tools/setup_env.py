#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0

"""Makes .venv, in which everything here runs: `make setup`. Standard library only.

Without a ROS 2 installation, .venv gets ROS 2 from PyPI (Jazzy, or another by --distro) and is
itself the ROS prefix: the messages are built into it, next to those of the wheels. With one
sourced, .venv borrows its rclpy and colcon and gets only the Python packages and our messages.
Where PyPI has no wheels of ROS 2, on AArch64, .venv gets everything but ROS.

Steps are stamped in .venv/setup.json with a hash of their inputs, so a second run does nothing and
an interrupted one is repaired: a venv that is not stamped complete is made anew.
"""

from __future__ import annotations

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C during the imports: no traceback

import argparse
import fcntl
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
SUPPORTED = ((3, 12), (3, 11), (3, 13), (3, 14))  # the ROS wheels exist for these
LAYOUT = "2"  # raise when this script changes so that older venvs will not do

CORE_REQUIREMENTS = ("requirements.txt", "requirements-dev.txt")
# Requirements of the ROS 2 distributions that PyPI has.
ROS_REQUIREMENTS = {"jazzy": "requirements-jazzy.txt", "kilted": "requirements-kilted.txt"}
DEFAULT_DISTRO = "jazzy"
NO_ROS = "none"
"""Stands for a distribution where PyPI has no wheels of ROS 2."""
# What only some targets need, by the stamp of its step.
EXTRA_REQUIREMENTS = {
    name: f"requirements-{name}.txt" for name in ("audit", "bench", "fuzz", "mujoco", "view")
}


class SetupError(Exception):
    """Something the person at the keyboard has to put right; the text says how."""


def main() -> int:
    """Bring .venv up to date; say what is being done only if something is."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    parser = argparse.ArgumentParser(description="Make or update the environment in .venv.")
    parser.add_argument("--venv", type=Path, default=CHECKOUT / ".venv")
    parser.add_argument("--distro", default="", help=f"default: {DEFAULT_DISTRO}")
    parser.add_argument("--extra", choices=EXTRA_REQUIREMENTS, help="with what these need besides")
    arguments = parser.parse_args()
    venv = Path(os.path.abspath(arguments.venv))
    try:
        # Two makes at once would delete each other's work.
        with open(__file__) as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            set_up(venv, arguments.distro)
            if arguments.extra:
                add_extra(venv, arguments.extra)
    except SetupError as error:
        print(f"setup: error: {error}", file=sys.stderr)
        return 1
    except PermissionError as error:
        print(
            f"setup: error: {error.filename} is another user's; one of your own: make VENV=FOLDER",
            file=sys.stderr,
        )
        return 1
    except KeyboardInterrupt:
        print("\nsetup: interrupted; the next run starts this step again", file=sys.stderr)
        return 130
    return 0


def set_up(venv: Path, wanted_distro: str) -> None:
    """Run the steps whose inputs changed since they were last completed."""
    sourced = os.environ.get("ROS_DISTRO", "")
    distro = choose_distro(wanted_distro, sourced)
    interpreter, version = choose_interpreter(any_version=bool(sourced))
    requirements = [*CORE_REQUIREMENTS, *filter(None, [ROS_REQUIREMENTS.get(distro)])]
    base_key = digest(
        [LAYOUT, interpreter, version, str(venv), str(CHECKOUT), sourced, distro],
        [CHECKOUT / name for name in requirements],
        [CHECKOUT / "tools" / "venv_startup.py"],
    )
    # Launch files and configuration count by their names: .venv holds links to them.
    installed = [*CHECKOUT.glob("launch/*.py"), *CHECKOUT.glob("config/**/*")]
    message_key = digest(
        sorted(str(path.relative_to(CHECKOUT)) for path in installed),
        sorted([*CHECKOUT.glob("msg/*.msg"), *CHECKOUT.glob("srv/*.srv")]),
        sorted(path for path in CHECKOUT.glob("scripts/*") if path.is_file()),
        [CHECKOUT / "CMakeLists.txt", CHECKOUT / "package.xml"],
        sorted(path for path in CHECKOUT.glob("tools/tf2_msgs/**/*") if path.is_file()),
    )
    protocol = CHECKOUT / "firmware" / "core" / "tactile_protocol.h"
    kernel_key = digest([*sorted(CHECKOUT.glob("kernel/*")), protocol])

    state = State(venv / "setup.json")
    started = time.monotonic()
    has_base = state.get("base") == base_key and (venv / "bin" / "python").exists()
    has_messages = has_base and state.get("messages") == message_key
    if has_messages and state.get("kernel") == kernel_key:
        return
    if has_messages:
        build_kernel(venv) if distro == NO_ROS else rebuild_kernel(venv)
        state.put("kernel", kernel_key)
        return
    use_installation = bool(sourced) and imports_rclpy(interpreter)
    if sourced and not use_installation:
        distro = distro if distro in ROS_REQUIREMENTS and has_wheels() else default_distro()
        print(
            f"setup: ROS_DISTRO is {sourced}, but {interpreter} cannot import rclpy: "
            f"using {of_pypi(distro)}"
        )
        if version_of(version) not in SUPPORTED:
            raise SetupError(unsupported(version))
    if distro == NO_ROS:
        print(
            f"setup: PyPI has no ROS 2 for {platform.machine()}, only for x86_64: setting up all "
            "but ROS. For topics, install ROS 2, source its setup.bash, and run make again",
            flush=True,
        )
    require_tools(interpreter, version_of(version))
    if not has_base:
        if venv.exists() and not state.path.exists():
            raise SetupError(f"{venv} was not made by this script; remove it, or set VENV=<other>")
        create_venv(venv, state, interpreter, version, sourced if use_installation else "")
        install_packages(venv, "" if use_installation else distro)
        adapt_venv(venv)
        state.put("base", base_key)
    state.put("messages", None)
    if distro == NO_ROS:
        build_kernel(venv)
    else:
        build_messages(venv, use_installation)
    state.put("messages", message_key)
    state.put("kernel", kernel_key)
    print(f"      ready after {time.monotonic() - started:.0f} s", flush=True)


def add_extra(venv: Path, name: str) -> None:
    """Install what only some targets need, unless it is there."""
    requirements = CHECKOUT / EXTRA_REQUIREMENTS[name]
    state = State(venv / "setup.json")
    key = digest([state.get("base") or ""], [requirements])
    if state.get(name) != key:
        print(f"setup: installing what {requirements.name} lists", flush=True)
        run([*pip_install(venv), "-r", str(requirements)], venv / "setup.log", explain=explain_pip)
        state.put(name, key)


# ---- the four steps -----------------------------------------------------------------------------


def create_venv(venv: Path, state: State, interpreter: str, version: str, sourced: str) -> None:
    """Make an empty venv, anew if a broken, interrupted or outdated one is there.

    sourced: the ROS 2 installation whose packages it sees; "": none.
    """
    ros = f" on ROS 2 {sourced}" if sourced else ""
    step(1, f"creating {os.path.relpath(venv)} with Python {version}{ros}")
    shutil.rmtree(venv, ignore_errors=True)
    state.put("base", None)  # marks the directory as ours from now on
    options = ["--system-site-packages"] if sourced else []
    run([interpreter, "-m", "venv", *options, str(venv)], venv / "setup.log")


def install_packages(venv: Path, distro: str) -> None:
    """Install what requirements*.txt list.

    distro: the ROS 2 to take from PyPI; "": that of an installation; NO_ROS: none.
    """
    names = list(CORE_REQUIREMENTS)
    if distro in ROS_REQUIREMENTS:
        step(2, f"installing {of_pypi(distro)} and Python packages (about 150 MB)")
        names.append(ROS_REQUIREMENTS[distro])
    else:
        step(2, "installing Python packages from PyPI")
    wanted = [argument for name in names for argument in ("-r", str(CHECKOUT / name))]
    if distro != NO_ROS and not shutil.which("cmake"):
        wanted.append("cmake>=3.22,<4")
    if not (distro or shutil.which("colcon")):
        wanted.append("colcon-common-extensions~=0.3.0")
    run([*pip_install(venv), *wanted], venv / "setup.log", explain=explain_pip)


def pip_install(venv: Path) -> list[str]:
    """Return the beginning of a pip command. Python compiles what is used when it is used."""
    pip = [str(venv / "bin" / "python"), "-m", "pip", "install", "--no-input", "--retries", "2"]
    return [*pip, "--no-compile", "--disable-pip-version-check", "--progress-bar", "off"]


def adapt_venv(venv: Path) -> None:
    """Make the wheels usable for building, and the venv's Python find the checkout."""
    step(3, "adapting the environment")
    python = venv / "bin" / "python"
    program = "import sysconfig as s; print(s.get_path('include'));print(s.get_path('purelib'))"
    include, site_packages = output([str(python), "-c", program]).splitlines()

    # The wheels' CMake exports name directories of the machine they were built on.
    prefix = r"/opt/python/cp3\d+-cp3\d+"
    for path in (venv / "share").glob("**/*.cmake"):
        text = path.read_text()
        ours = re.sub(prefix + r"/include/python3\.\d+", include, text)
        ours = re.sub(prefix + r"/lib/python3\.\d+/site-packages", site_packages, ours)
        if ours != text:
            path.write_text(ours)

    startup = Path(site_packages, "_tactile_cdma_venv.py")
    shutil.copy(CHECKOUT / "tools" / "venv_startup.py", startup)
    startup.with_suffix(".pth").write_text(
        f"import _tactile_cdma_venv; _tactile_cdma_venv.start({str(CHECKOUT)!r})\n"
    )
    Path(site_packages, "zz_tactile_cdma_venv.pth").write_text(
        "import _tactile_cdma_venv; _tactile_cdma_venv.end()\n"
    )
    # sh finds the interpreter, so that blanks or great length of its path do no harm.
    command = venv / "bin" / "tactile-cdma"
    command.write_text(
        f"#!/bin/sh\n'''exec' \"{python}\" \"$0\" \"$@\"\n' '''\n"
        "import signal\nimport sys\n\n"
        "signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback of the imports\n\n"
        "from tactile_cdma.__main__ import main\n\nsys.exit(main())\n"
    )
    command.chmod(0o755)


def build_messages(venv: Path, use_installation: bool) -> None:
    """Build this package with colcon, into the venv itself, and messages that PyPI lacks.

    Optimised, but with assertions, as a plain `colcon build` has them: so all tests are run with
    these.

    The kernel is part of it: a machine that can compile the messages can compile the kernel.
    """
    step(4, "building the messages and the kernel")
    shutil.rmtree(venv / "build", ignore_errors=True)
    packages = [CHECKOUT] if use_installation else [CHECKOUT, CHECKOUT / "tools" / "tf2_msgs"]
    environment = dict(os.environ, PATH=f"{venv / 'bin'}{os.pathsep}{os.environ['PATH']}")
    for variable in ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"):
        # Without a ROS installation nothing else is a ROS prefix, whatever the variables say.
        others = os.environ.get(variable, "") if use_installation else ""
        environment[variable] = os.pathsep.join(filter(None, [str(venv), others]))
    build = ["colcon", "--log-base", str(venv / "log"), "build", "--paths", *map(str, packages)]
    build += ["--build-base", str(venv / "build"), "--install-base", str(venv)]
    build += ["--merge-install", "--symlink-install"]
    build += ["--event-handlers", "console_direct+"]  # make's percentages, for the terminal
    build += ["--cmake-args", "-DBUILD_TESTING=OFF", "--no-warn-unused-cli"]
    build += ["-DCMAKE_C_FLAGS=-O2", "-DCMAKE_CXX_FLAGS=-O2"]
    build += [f"-DPython3_EXECUTABLE={venv / 'bin' / 'python'}"]
    run(build, venv / "setup.log", environment)
    # A run that failed here must not be mistaken for a good one.
    run([str(venv / "bin" / "python"), "-c", "import rclpy, tactile_cdma.msg"], venv / "setup.log")


def build_kernel(venv: Path) -> None:
    """Build the kernel into the venv where no ROS is, by which the messages would be built."""
    step(4, "building the kernel")
    python = str(venv / "bin" / "python")
    place = output([python, "-c", "import sysconfig as s; print(s.get_path('purelib'))"])
    build = [python, "setup.py", "-q", "build_ext", "--build-lib", place]
    run([*build, "--build-temp", str(venv / "build")], venv / "setup.log")
    # A module that does not load is no good build.
    run([python, "-c", "import tactile_cdma._kernel"], venv / "setup.log")


def rebuild_kernel(venv: Path) -> None:
    """Build the kernel anew where only its sources changed; .venv holds a link to it."""
    print("setup: building the kernel", flush=True)
    build = ["cmake", "--build", str(venv / "build" / "tactile_cdma")]
    path = f"{venv / 'bin'}{os.pathsep}{os.environ['PATH']}"
    environment = dict(os.environ, PATH=path)
    run([*build, "--target", "tactile_cdma_kernel"], venv / "setup.log", environment)


# ---- what the machine has -----------------------------------------------------------------------


def choose_distro(wanted: str, sourced: str) -> str:
    """Return the ROS 2 distribution to use. wanted, sourced: "" for none."""
    if sourced and wanted not in ("", sourced):
        raise SetupError(
            f"DISTRO={wanted} was asked for, but ROS 2 {sourced} is sourced (ROS_DISTRO): leave "
            "DISTRO out, or start from a shell in which no ROS 2 is sourced"
        )
    if wanted and not sourced and not has_wheels():
        raise SetupError(
            f"DISTRO={wanted}: PyPI has no ROS 2 for {platform.machine()}, only for x86_64; "
            "install ROS 2 and source its setup.bash, or leave DISTRO out to do without ROS"
        )
    if wanted and not sourced and wanted not in ROS_REQUIREMENTS:
        raise SetupError(
            f"DISTRO={wanted}: PyPI has ROS 2 only as {' and '.join(ROS_REQUIREMENTS)}; for "
            "another one, install it, source its setup.bash and leave DISTRO out"
        )
    return wanted or sourced or default_distro()


def has_wheels() -> bool:
    """Tell whether PyPI has ROS 2 for this processor."""
    return platform.machine() == "x86_64"


def default_distro() -> str:
    """Return what is set up without a wish and without an installation."""
    return DEFAULT_DISTRO if has_wheels() else NO_ROS


def of_pypi(distro: str) -> str:
    """Name what is taken from PyPI."""
    return "no ROS" if distro == NO_ROS else f"ROS 2 {distro.capitalize()} from PyPI"


def choose_interpreter(any_version: bool) -> tuple[str, str]:
    """Return path and full version of the Python to build the venv on."""
    # From inside a venv, even this one, its base: the venv may be about to be deleted.
    # Without links, for inside a venv it has another name than outside.
    own = os.path.realpath(getattr(sys, "_base_executable", sys.executable))
    if any_version or sys.version_info[:2] in SUPPORTED:
        return own, platform.python_version()
    for major, minor in SUPPORTED:
        found = shutil.which(f"python{major}.{minor}")
        try:
            version = output([found, "-c", "import platform; print(platform.python_version())"])
        except (TypeError, OSError, subprocess.CalledProcessError):
            continue  # not there, or a shim with nothing behind it
        return str(found), version
    raise SetupError(unsupported(platform.python_version()))


def unsupported(version: str) -> str:
    """Say what to do about a Python the ROS wheels do not exist for."""
    known = sorted(f"{major}.{minor}" for major, minor in SUPPORTED)
    return (
        f"ROS 2 from PyPI needs Python {', '.join(known)}, and this is {version}; install one of "
        f"them (apt install python{known[0]}-venv python{known[0]}-dev, or pyenv), or source a "
        "ROS 2 installation"
    )


def imports_rclpy(interpreter: str) -> bool:
    """Tell whether the sourced ROS 2 installation works with this interpreter."""
    return subprocess.run([interpreter, "-c", "import rclpy"], capture_output=True).returncode == 0


def require_tools(interpreter: str, version: tuple[int, int]) -> None:
    """Install missing system packages if that needs no questions; otherwise name them."""
    install(missing_packages(interpreter, version))
    if packages := missing_packages(interpreter, version):
        raise SetupError(f"needed on this machine: sudo apt install {' '.join(packages)}")


def install(packages: list[str]) -> None:
    """Install Debian packages, if that needs no question."""
    if not packages or not shutil.which("apt-get") or not may_be_root():
        return
    apt_get = ["apt-get"] if os.geteuid() == 0 else ["sudo", "apt-get"]
    command = [*apt_get, "install", "-y", "--no-install-recommends", *packages]
    print(" ".join(command), flush=True)
    subprocess.run([*apt_get, "update"], stdout=subprocess.DEVNULL, check=False)
    if subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode:
        for package in packages:  # apt installs none where one cannot be had
            one = [*command[: -len(packages)], package]
            subprocess.run(one, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)


def may_be_root() -> bool:
    """Tell whether system packages can be installed without a question."""
    if os.geteuid() == 0:
        return True
    sudo = shutil.which("sudo")
    return bool(sudo) and subprocess.run([sudo, "-n", "true"], capture_output=True).returncode == 0


def missing_packages(interpreter: str, version: tuple[int, int]) -> list[str]:
    """Return Debian names of the packages that this machine lacks. cmake may come from PyPI."""
    python = f"python{version[0]}.{version[1]}"
    probe = (
        "import importlib.util as u, os, sysconfig;"
        "print(int(bool(u.find_spec('ensurepip') and u.find_spec('venv'))),"
        "int(os.path.exists(os.path.join(sysconfig.get_path('include'), 'Python.h'))))"
    )
    has_venv, has_headers = output([interpreter, "-c", probe]).split()
    missing = []
    if has_venv == "0":
        missing.append(f"{python}-venv")
    if has_headers == "0":
        missing.append(f"{python}-dev")
    if not (shutil.which("c++") and shutil.which("cc")):
        missing.append("g++")
    if not shutil.which("make"):
        missing.append("make")
    return missing


# ---- helpers ------------------------------------------------------------------------------------


class State:
    """The stamps of completed steps, in a JSON file inside the venv."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def _load(self) -> dict[str, str | None]:
        try:
            return dict(json.loads(self.path.read_text()))
        except (OSError, ValueError):
            return {}

    def get(self, name: str) -> str | None:
        """Return the stamp of a step; None: not complete."""
        return self._load().get(name)

    def put(self, name: str, key: str | None) -> None:
        """Stamp a step complete, or with None incomplete."""
        stamps = {**self._load(), name: key}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        temporary = self.path.with_suffix(".tmp")
        temporary.write_text(json.dumps(stamps))
        temporary.replace(self.path)


def digest(*groups: list[str] | list[Path]) -> str:
    """Hash strings and the contents of files."""
    total = hashlib.sha256()
    for item in (item for group in groups for item in group):
        content = item.read_bytes() if isinstance(item, Path) else item.encode()
        name = item.name if isinstance(item, Path) else ""
        total.update(repr((name, content)).encode())
    return total.hexdigest()


def run(command: list[str], log: Path, env: dict[str, str] | None = None, explain=None) -> None:
    """Run a step's command; its output goes to the log, what it is at to the terminal."""
    with log.open("ab") as sink:
        begin = sink.tell()
        process = subprocess.Popen(
            command,
            cwd=CHECKOUT,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=sink,
            stderr=subprocess.STDOUT,
        )
        started = time.monotonic()
        try:
            while True:
                try:
                    code = process.wait(timeout=15)
                    break
                except subprocess.TimeoutExpired:
                    said = last_line(log, begin)
                    print(f"      … {time.monotonic() - started:.0f} s{said}", flush=True)
        except KeyboardInterrupt:
            process.wait()  # the terminal has interrupted it too; do not pull its log away
            raise
    if code:
        text = log.read_bytes()[begin:].decode(errors="replace")
        print("\n".join(text.splitlines()[-20:]), file=sys.stderr)
        hint = explain(text) if explain else None
        raise SetupError(hint or f"`{Path(command[0]).name}` failed (above; all of it in {log})")


def last_line(log: Path, begin: int) -> str:
    """Return what pip or colcon began last, as ": [ 45%] Building C object …"; may be empty."""
    text = log.read_bytes()[begin:].decode(errors="replace")
    begun = re.findall(r"^ *((?:Collecting|Downloading|Installing|\[ *\d+%\]) .*)$", text, re.M)
    return f": {begun[-1][:70]}" if begun else ""


def explain_pip(text: str) -> str | None:
    """Translate pip's usual troubles."""
    offline = "NewConnectionError|NameResolutionError|Max retries|ProxyError|timed out"
    if re.search(offline, text):
        return "PyPI cannot be reached; check the network (behind a proxy: set https_proxy)"
    if re.search(r"No matching distribution found for ros-", text):
        return (
            "PyPI has no ROS 2 wheels for this platform (they are for Linux with glibc): install "
            "ROS 2, source its setup.bash and run make again; or do without ROS: pip install ."
        )
    return None


def output(command: list[str]) -> str:
    """Return what a short command prints."""
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def version_of(version: str) -> tuple[int, int]:
    """Return (3, 11) for "3.11.7"."""
    major, minor = version.split(".")[:2]
    return int(major), int(minor)


def step(number: int, text: str) -> None:
    """Show progress."""
    print(f"[{number}/4] {text}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
