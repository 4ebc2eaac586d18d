# SPDX-License-Identifier: Apache-2.0

"""Scripts that no package has, as modules; and what `make run` starts."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[2]


def loaded(path: Path) -> ModuleType:
    spec = spec_from_file_location(path.stem.replace(".", "_"), path)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def body_commands(path: Path) -> list[list[str]]:
    """What `make run PATCHES=path` starts: the drivers, and the body's node."""
    commands: list[list[str]] = loaded(ROOT / "tools" / "run.py").body_commands(path)
    return commands
