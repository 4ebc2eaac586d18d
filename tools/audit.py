#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0

"""Audits what the driver stands on: `make audit`. pip-audit does it, by the advisories of osv.dev.

And what can be told without a network: whether versions are bounded, whether those installed fit
each other, whether packages of npm are locked to their content. Exit codes: 0 all is well, 1
something is not, 2 the advisories cannot be had.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
LOCK = ROOT / "firmware" / "sim" / "package-lock.json"
BOUNDS = {"<", "<=", "==", "===", "~="}
OFFLINE = "ConnectionError|NameResolution|Max retries|ProxyError|ConnectTimeout|ReadTimeout"
TOOL = [sys.executable, "-m", "pip_audit", "--vulnerability-service", "osv", "--format", "json"]
TOOL += ["--local", "--skip-editable", "--progress-spinner", "off"]


class AdvisoriesError(Exception):
    """Advisories cannot be had; the text says why."""


def main() -> int:
    """Say what is wrong, a line each, and sum up."""
    wrong = [*unbounded(requirements()), *unlocked(json.loads(LOCK.read_text())), *misfits()]
    reason = ""
    try:
        wrong += advisories()
    except AdvisoriesError as error:
        reason = str(error)
    print(*wrong, sep="\n", end="\n" if wrong else "")
    if reason:
        print(f"audit: advisories not looked up: {reason}", file=sys.stderr)
    print(f"problems={len(wrong)} advisories={'unknown' if reason else 'checked'}")
    return 1 if wrong else 2 if reason else 0


def requirements() -> dict[str, list[str]]:
    """Read all requirements of this repository, by the file that they are in."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    found = {"pyproject.toml": list(project["build-system"]["requires"])}
    for path in sorted(ROOT.glob("requirements*.txt")):
        lines = (line.split("#")[0].strip() for line in path.read_text().splitlines())
        found[path.name] = [line for line in lines if line]
    return found


def unbounded(files: dict[str, list[str]]) -> Iterator[str]:
    """List requirements that any later version would fulfil, untested as it is."""
    for name, lines in files.items():
        for line in lines:
            if not BOUNDS & {each.operator for each in Requirement(line).specifier}:
                yield f"{name}: {line}: no upper bound"


def unlocked(lock: dict[str, Any]) -> Iterator[str]:
    """List packages of npm that could change their content."""
    for name, package in lock["packages"].items():
        if name and not str(package.get("integrity", "")).startswith("sha512-"):
            yield f"{LOCK.name}: {name}: no sha512 of its content"


def misfits() -> list[str]:
    """Tell what `pip check` says of the installed packages."""
    check = [sys.executable, "-m", "pip", "--disable-pip-version-check", "check"]
    done = subprocess.run(check, capture_output=True, text=True)
    return done.stdout.splitlines() if done.returncode else []


def advisories() -> list[str]:
    """Return known vulnerabilities of the installed packages; raises AdvisoriesError."""
    done = subprocess.run(TOOL, capture_output=True, text=True)
    try:
        return list(told(json.loads(done.stdout)["dependencies"]))
    except ValueError:
        raise AdvisoriesError(why(done.stderr)) from None


def told(dependencies: Iterable[dict[str, Any]]) -> Iterator[str]:
    """Write a line for each vulnerability in what pip-audit found."""
    for package in dependencies:
        for found in package.get("vulns", []):
            mended = ", ".join(found["fix_versions"]) or "no version"
            yield f"{package['name']} {package['version']}: {found['id']}, mended in {mended}"


def why(complaint: str) -> str:
    """Find the reason in what pip-audit wrote before it gave up."""
    if re.search(OFFLINE, complaint):
        return "osv.dev cannot be reached; check the network (behind a proxy: set https_proxy)"
    return (complaint.strip().splitlines() or ["pip-audit said nothing"])[-1]


if __name__ == "__main__":
    sys.exit(main())
