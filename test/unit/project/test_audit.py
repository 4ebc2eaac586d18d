# SPDX-License-Identifier: Apache-2.0

"""`make audit`: its verdict on this repository, and on requirements that it must refuse."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[3] / "tools"))
import audit


def test_every_requirement_has_an_upper_bound() -> None:
    assert list(audit.unbounded(audit.requirements())) == []


@pytest.mark.parametrize(
    "line", ["numpy", "numpy>=1.26", "numpy!=2.0", 'numpy>1;python_version<"4"']
)
def test_an_unbounded_requirement_is_named_with_its_file(line: str) -> None:
    [found] = audit.unbounded({"requirements.txt": ["pyserial>=3.5,<4", line]})
    assert found == f"requirements.txt: {line}: no upper bound"


def test_a_package_of_npm_without_its_hash_is_named() -> None:
    locked = {"": {"name": "own"}, "node_modules/a": {"integrity": "sha512-x"}}
    assert list(audit.unlocked({"packages": locked})) == []
    for package in ({}, {"integrity": "sha1-x"}):
        [found] = audit.unlocked({"packages": {**locked, "node_modules/b": package}})
        assert "node_modules/b" in found


def test_vulnerabilities_are_told_with_what_mends_them() -> None:
    """In the form in which pip-audit 2.10 writes them."""
    found = {"id": "PYSEC-2099-1", "fix_versions": ["3.6"], "aliases": [], "description": ""}
    dependencies = [
        {"name": "numpy", "version": "2.4.6", "vulns": []},
        {"name": "ours", "skip_reason": "not on PyPI"},
        {"name": "pyserial", "version": "3.5", "vulns": [found, {**found, "fix_versions": []}]},
    ]
    assert list(audit.told(dependencies)) == [
        "pyserial 3.5: PYSEC-2099-1, mended in 3.6",
        "pyserial 3.5: PYSEC-2099-1, mended in no version",
    ]


@pytest.mark.parametrize(
    ("complaint", "reason"),
    [
        ("trace\nrequests.exceptions.ConnectionError: HTTPSConnectionPool", "cannot be reached"),
        ("/usr/bin/python3: No module named pip_audit\n", "No module named pip_audit"),
        ("", "said nothing"),
    ],
)
def test_advisories_that_cannot_be_had_are_no_clean_bill(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], complaint: str, reason: str
) -> None:
    program = f"import sys; sys.exit({complaint!r})"
    monkeypatch.setattr(audit, "TOOL", [sys.executable, "-c", program])
    monkeypatch.setattr(audit, "misfits", list)
    assert audit.main() == 2
    out, err = capsys.readouterr()
    assert out == "problems=0 advisories=unknown\n"
    assert reason in err and len(err.splitlines()) == 1
