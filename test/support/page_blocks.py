# SPDX-License-Identifier: Apache-2.0

"""Code blocks of README and docs: what each is, and whether a test can run it as documented."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]

NOT_RUN = {
    "needs a board": r"/dev/tty|usb://|--programmer|--flash|^avrdude|make demo|git clone",
    "needs a ROS 2 installation": r"^(\w+\$ +)?(ros2|rosdep|colcon|export ROS_)",
    "needs root, or another computer's clock": r"^sudo |^local stratum|^server ",
    "needs a robot's bag, or LeRobot": r"session|export a b c|^lerobot-",
    "needs a capture of loads": r"--capture",
    "goes on until it is ended": r"^tactile-cdma (view|simulate)|\./skin-tty|serve\.py|^rerun ",
    "needs a driver beside it": r"examples/subscribe\.py",
    "takes minutes, or a network": r"^make (?!help)|^(\S*/)?pip ",
    "lasts as long as the loads: 82 s": r"steps\.skin",
    "asks what is plugged in": r"^tactile-cdma (ports|doctor)",
}
"""Reasons not to run a command here, by what it looks like."""
SAYS_NOTHING_TO_RUN = {
    "a drawing or a formula": r"[→▶─▔·←⌊≠]|XOR|C\[0",
    "the layout of bytes": r"^(offset|type|packet) |^\d+ µs",
    "what a program prints": r"^(ok|problem|warning) +\w|^\{\"t\"",
    "a part of a program": r"self\.skin = |observation\.|TopicObservation",
}
"""What blocks are that hold no command, file or program, by what they look like."""
SHELL = re.compile(r"^(?:\w*\$ +)?((?:tactile-cdma|make|ros2|python|sudo|git|rosdep|colcon) .*)")
OTHERS = re.compile(r"^(?:\w*\$ +)(.*)|^(export .*|lerobot-.*|\.venv/bin/.*|SKIN=.*|server .*)")


@dataclass(frozen=True)
class Block:
    """A code block of a page. line: of the page, from 1 on. language: "" for an indented one."""

    page: Path
    line: int
    language: str
    text: str

    @property
    def place(self) -> str:
        return f"{self.page.name}:{self.line}"

    @property
    def commands(self) -> list[str]:
        """Commands for a shell, without prompts and comments, each on one line."""
        found = []
        for line in self.text.replace("\\\n", " ").splitlines():
            match = SHELL.match(line) or OTHERS.match(line)
            if match and not self.language:
                command = next(part for part in match.groups() if part)
                found.append(re.split(r" {2,}#| # ", command)[0].strip(" &"))
        return found

    @property
    def is_yaml(self) -> bool:
        """Whether it is a parameter, body or calibration file."""
        return not self.language and bool(re.match(r"(/\S*|[a-z_]+):( \S.*)?$", self.text, re.M))

    @property
    def is_python(self) -> bool:
        """Whether it is a program."""
        return self.language == "python" or self.text.startswith("# loads.py")

    @property
    def why_not(self) -> str:
        """Why nothing of it can be run: a reason of those above, or nothing."""
        if self.commands:
            return ""
        for reason, look in SAYS_NOTHING_TO_RUN.items():
            if re.search(look, self.text, re.MULTILINE):
                return reason
        return ""


def blocks(page: Path) -> list[Block]:
    """All code blocks of a page: fenced ones, and indented ones after a blank line or a heading.

    Tables between the comments `begin` and `end` are generated, and left out.
    """
    text = page.read_text(encoding="utf-8")
    blank = lambda found: "\n" * found[0].count("\n")  # noqa: E731
    text = re.sub(r"<!-- ?begin.*?<!-- ?end ?-->", blank, text, flags=re.DOTALL)
    return list(_found(page, text.splitlines()))


def _found(page: Path, lines: list[str]) -> Iterator[Block]:
    number = 0
    while number < len(lines):
        line, begin = lines[number], number
        if line.startswith("```"):
            number = lines.index("```", number + 1) + 1
            yield Block(page, begin + 1, line[3:], "\n".join(lines[begin + 1 : number - 1]) + "\n")
        elif line.startswith("    ") and (number == 0 or re.match(r"$|#+ ", lines[number - 1])):
            while number < len(lines) and re.match(r"    |$", lines[number]):
                number += 1
            text = "\n".join(one[4:] for one in lines[begin:number]).rstrip() + "\n"
            yield Block(page, begin + 1, "", text)
        else:
            number += 1


def reason(command: str) -> str:
    """Why a command is not run here; nothing, if it is."""
    for why, look in NOT_RUN.items():
        if re.search(look, command):
            return why
    return ""
