"""The page of all commands and options, from the parser of the command line.

python docs/command_reference.py

writes ``docs/commands.md``; a test compares it with the parser.
"""

import argparse
import re
from collections.abc import Iterator
from pathlib import Path

from curvireg_torch.cli import build_parser

PAGE = Path(__file__).with_name("commands.md")

HEAD = """# Commands and options

Made from the parser by `python docs/command_reference.py`; `curvireg COMMAND --help` prints the
same, with examples. The [guides](guides/index.md) show when an option helps, and
[Results](results.md) what is written. Every command has `--help`, and `--debug`, which shows the
traceback of an error.
"""

# Options that the head of the page describes
COMMON = {"help", "debug"}


def commands(parser: argparse.ArgumentParser, name: str = "") -> Iterator[tuple[str, str, object]]:
    """Name, help and parser of each command, and of each part of one."""
    for action in parser._actions:
        if not isinstance(action, argparse._SubParsersAction):
            continue
        helps = {choice.dest: choice.help or "" for choice in action._choices_actions}
        for word, child in action.choices.items():
            full_name = f"{name} {word}".strip()
            yield full_name, helps.get(word, ""), child
            yield from commands(child, full_name)


def cell(text: str) -> str:
    """Text as a cell of a table."""
    one_line = " ".join(text.split())
    return re.sub(r"([|<>*_])", r"\\\1", one_line)


def words_of(action: argparse.Action, formatter: argparse.HelpFormatter) -> str:
    """An option with its values, or an argument, as it is typed."""
    if not action.option_strings:
        return formatter._format_args(action, action.dest.upper())
    names = ", ".join(action.option_strings)
    if action.nargs == 0:
        return names
    return f"{names} {formatter._format_args(action, action.dest.upper())}"


def rows(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    """Each argument and option as it is typed, and its meaning."""
    formatter = parser._get_formatter()
    for action in parser._actions:
        is_hidden = action.help == argparse.SUPPRESS or action.dest in COMMON
        if is_hidden or isinstance(action, argparse._SubParsersAction):
            continue
        help_text = formatter._expand_help(action) if action.help else ""
        needed = "required; " if action.required and action.option_strings else ""
        code = words_of(action, formatter).replace("|", "\\|")
        yield code, cell(needed + help_text)


def page() -> str:
    """The page as Markdown. An option that several commands have in one meaning is explained once,
    below them."""
    found = [
        (name, summary, parser, list(rows(parser)))
        for name, summary, parser in commands(build_parser())
        if isinstance(parser, argparse.ArgumentParser)
    ]
    users: dict[tuple[str, str], list[str]] = {}
    for name, _, _, table in found:
        for row in table:
            users.setdefault(row, []).append(name)
    shared = {row: names for row, names in users.items() if len(names) > 1 and row[0][0] == "-"}
    parts = [HEAD]
    for name, summary, parser, table in found:
        parts.append(f"\n## curvireg {name}\n")
        description = cell(parser.description or "") or summary
        if description:
            parts.append(f"\n{description[0].upper()}{description[1:]}\n")
        own = [
            f"| `{code}` | {meaning} |" for code, meaning in table if (code, meaning) not in shared
        ]
        if own:
            parts.append("\n| argument or option | meaning |\n|---|---|\n" + "\n".join(own) + "\n")
        others = [f"`{code.split()[0]}`" for code, meaning in table if (code, meaning) in shared]
        if others:
            parts.append(f"\n[Also](#options-of-several-commands) {', '.join(others)}.\n")
    parts.append("\n## Options of several commands\n\n| option | meaning | of |\n|---|---|---|\n")
    lines = [
        f"| `{code}` | {meaning} | {', '.join(names)} |"
        for (code, meaning), names in shared.items()
    ]
    return "".join([*parts, "\n".join(lines), "\n"])


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
