#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0

"""Counts the numeric constants by which frames and words are judged: the fewer, the better.

    .venv/bin/python tools/constants.py        --list: every constant, its value and its place

A constant is a number that a name in capitals gets at the level of a module, alone, in an
assignment of several, or as an element of a tuple or list; and a field with a number in a class
whose name ends in Limits. A number that follows from other names is none.

`benchmarks.doubt.ablate` finds the constants by the same walk, and puts other values in their place
(`replaced`).
"""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "tactile_cdma"
HEART = ("framing", "words", "code", "clocks")
"""Folders of the package that decide what was sent."""
CHOSEN = "Chosen"
"""Word by which a docstring tells of a value that was found by trying, not derived."""
MOST, MOST_CHOSEN = 90, 30
"""Most that there may be: constants, and those of them that are CHOSEN."""
FIELDS = re.compile(r"^ *((?:[a-z]\w*, )*[a-z]\w*): ", re.MULTILINE)
"""Begin of what a docstring says of a class's fields."""


@dataclass(frozen=True, slots=True)
class Constant:
    """A number with a name.

    module: dotted. name: NAME, NAME[1] of a tuple, Limits.field. line: in its file, from 1.
    """

    module: str
    name: str
    value: float
    line: int
    is_chosen: bool

    @property
    def folder(self) -> str:
        """Return the heart's folder that the constant is in."""
        return self.module.split(".")[1]

    @property
    def title(self) -> str:
        """Return the name with its module's: judge.RULED_OUT."""
        return f"{self.module.rsplit('.', 1)[-1]}.{self.name}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--list", action="store_true", help="every constant")
    found = heart()
    if parser.parse_args().list:
        for one in found:
            print(f"{one.module}:{one.line} {one.name} = {one.value:g}")
    print(f"{'folder':8} {'constants':>9} {CHOSEN:>6}")
    for folder in HEART:
        some = [one for one in found if one.folder == folder]
        print(f"{folder:8} {len(some):9} {sum(one.is_chosen for one in some):6}")
    chosen = sum(one.is_chosen for one in found)
    print(f"{'all':8} {len(found):9} {chosen:6}")
    print(f"{'goal':8} {MOST:9} {MOST_CHOSEN:6}")


def heart(root: Path = ROOT) -> list[Constant]:
    """Return all constants of the heart, in the order of its folders and files."""
    return [
        constant
        for folder in HEART
        for path in sorted((root / PACKAGE / folder).rglob("*.py"))
        for constant in constants(
            ".".join(path.relative_to(root).with_suffix("").parts), path.read_text("utf-8")
        )
    ]


def constants(module: str, source: str) -> Iterator[Constant]:
    """Return the constants of a module's text."""
    for name, node, is_chosen in _found(ast.parse(source)):
        yield Constant(module, name, _value(node), node.lineno, is_chosen)


def replaced(source: str, values: Mapping[str, float]) -> ast.Module:
    """Make a module with other values of some constants. Raises KeyError for one it has not."""
    tree = ast.parse(source)
    places = {name: node for name, node, _ in _found(tree)}
    news = {id(places[name]): ast.Constant(value) for name, value in values.items()}

    class Swap(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST:
            return news.get(id(node)) or self.generic_visit(node)

    swapped = Swap().visit(tree)
    assert isinstance(swapped, ast.Module)
    return ast.fix_missing_locations(swapped)


def _found(tree: ast.Module) -> Iterator[tuple[str, ast.expr, bool]]:
    """Name, value and whether it is CHOSEN, of all constants."""
    for at, statement in enumerate(tree.body):
        if isinstance(statement, ast.ClassDef) and statement.name.endswith("Limits"):
            yield from _fields(statement)
        for target, value in _assigned(statement):
            if isinstance(target, ast.Name) and target.id == target.id.upper():
                is_chosen = CHOSEN in _text(tree.body[at + 1 : at + 2])
                yield from ((name, node, is_chosen) for name, node in _numbers(target.id, value))


def _fields(limits: ast.ClassDef) -> Iterator[tuple[str, ast.expr, bool]]:
    """Yield a class's fields that are constants; its docstring, or one behind each, has reasons."""
    _, *parts = FIELDS.split(ast.get_docstring(limits) or "")
    texts = {
        name: text
        for names, text in zip(parts[::2], parts[1::2], strict=True)
        for name in names.split(", ")
    }
    for at, statement in enumerate(limits.body):
        for target, value in _assigned(statement):
            if isinstance(target, ast.Name):
                text = texts.get(target.id, "") + _text(limits.body[at + 1 : at + 2])
                for name, node in _numbers(f"{limits.name}.{target.id}", value):
                    yield name, node, CHOSEN in text


def _assigned(statement: ast.stmt) -> list[tuple[ast.expr, ast.expr]]:
    """Yield targets and their values: A = 1, A: float = 1, and A, B = 1, 2."""
    if isinstance(statement, ast.AnnAssign) and statement.value is not None:
        return [(statement.target, statement.value)]
    if not isinstance(statement, ast.Assign):
        return []
    target, value = statement.targets[0], statement.value
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        return list(zip(target.elts, value.elts, strict=True))
    return [(target, value)]


def _numbers(name: str, node: ast.expr) -> Iterator[tuple[str, ast.expr]]:
    """Names and places of the numbers that a name gets."""
    if isinstance(node, ast.Call) and len(node.args) == 1 and isinstance(node.args[0], ast.List):
        node = node.args[0]  # np.array([1, 2])
    if isinstance(node, ast.Tuple | ast.List):
        for at, element in enumerate(node.elts):
            yield from _numbers(f"{name}[{at}]", element)
    elif _is_number(node):
        yield name, node


def _is_number(node: ast.expr) -> bool:
    """Tell whether it is a number or follows from nothing but numbers: -1, 1 / 16, 1 << 18."""
    if isinstance(node, ast.UnaryOp):
        return _is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return _is_number(node.left) and _is_number(node.right)
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def _value(node: ast.expr) -> float:
    expression = compile(ast.Expression(node), "constant", "eval")
    value: float = eval(expression, {"__builtins__": {}})  # noqa: S307  (numbers only)
    return value


def _text(statements: list[ast.stmt]) -> str:
    """Return the docstring behind an assignment, where there is one."""
    match statements:
        case [ast.Expr(ast.Constant(str(text)))]:
            return text
    return ""


if __name__ == "__main__":
    main()
