# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma completion`: prints what bash needs to complete the others.

A script that is made once, rather than a library that is asked at every press of Tab: starting the
command takes half a second.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable

from ..config.parameters import BY_NAME

SCRIPT = """\
# Completion of tactile-cdma {version} for bash, made by `tactile-cdma completion`.
_tactile_cdma() {{
    local word=${{COMP_WORDS[COMP_CWORD]}} words
    if [ "$COMP_CWORD" = 1 ]; then
        words='{commands}'
    else
        case "${{COMP_WORDS[1]}} ${{COMP_WORDS[COMP_CWORD - 1]}}" in
{choices}
        *)
            [[ $word == -* ]] || return  # a file
            case "${{COMP_WORDS[1]}}" in
{options}
            esac ;;
        esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o default -F _tactile_cdma tactile-cdma
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """It has none."""


def run(arguments: argparse.Namespace) -> int:
    """Print the script; returns the exit code."""
    from .. import __version__
    from .cli import make_parser  # which imports this module

    print(script(make_parser(), __version__), end="")
    return 0


def script(parser: argparse.ArgumentParser, version: str) -> str:
    """The completion of a parser whose arguments all belong to subcommands."""
    [commands] = (a.choices for a in parser._actions if isinstance(a.choices, dict))
    options, choices = [], []
    for name, subcommand in commands.items():
        known = [option for action in subcommand._actions for option in action.option_strings]
        options.append(f"            {name}) words='{' '.join(known)}' ;;")
        for action in subcommand._actions:
            values = action.choices or _choices_of_parameter(action.dest)
            if action.option_strings and values:
                cases = "|".join(f'"{name} {option}"' for option in action.option_strings)
                words = " ".join(map(str, values))
                choices.append(f"        {cases}) words='{words}' ;;")
    return SCRIPT.format(
        version=version,
        commands=" ".join(commands),
        options="\n".join(options),
        choices="\n".join(choices),
    )


def _choices_of_parameter(name: str) -> Iterable[object]:
    """What a parameter of a skin can be; nothing for one of any value, or for no parameter."""
    return BY_NAME[name].choices if name in BY_NAME else ()
