# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Writes what each module is for into docs/architecture.md; --check only compares.

The rows of the page's last section say which modules stand where; their texts are the modules'
own top lines.
"""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "tactile_cdma"
PAGE = ROOT / "docs" / "architecture.md"
SECTION = "\n## Modules\n"
ROW = re.compile(r"^\| `([\w/]+\.py)` \|.*$", re.MULTILINE)


def purpose(module: str) -> str:
    """The top line of a module, a path below the package."""
    text = ast.get_docstring(ast.parse((PACKAGE / module).read_text(encoding="utf-8")))
    return (text or "").splitlines()[0].replace("|", "\\|")


def with_purposes(section: str) -> str:
    """The section with the present top lines."""
    return ROW.sub(lambda row: f"| `{row[1]}` | {purpose(row[1])} |", section)


def main() -> int:
    page = PAGE.read_text(encoding="utf-8")
    before, section = page.split(SECTION)
    existing = [str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py")]
    named = ROW.findall(section)
    wrong = [f"{name} has no row" for name in sorted({*existing} - {*named})]
    wrong += [f"{name} does not exist" for name in sorted({*named} - {*existing})]
    wrong += [f"{name} has two rows" for name in sorted({n for n in named if named.count(n) > 1})]
    if wrong:
        print(f"{PAGE.relative_to(ROOT)}: {'; '.join(wrong)}", file=sys.stderr)
        return 1
    text = before + SECTION + with_purposes(section)
    if "--check" in sys.argv:
        if text != page:
            print("stale: run tools/module_table.py", file=sys.stderr)
        return int(text != page)
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
