"""Completion of the command line in bash, zsh and fish, made from its parser."""

import argparse
import shlex
from collections.abc import Iterator, Sequence

__all__ = ["SHELLS", "script"]

SHELLS = ("bash", "zsh", "fish")

_BASH = """\
_curvireg() {{
    local word path='' words='' commands=''
    COMPREPLY=()
    for word in "${{COMP_WORDS[@]:1:$((COMP_CWORD - 1))}}"; do
        case "$path $word" in
{paths}
        esac
    done
    case "$path ${{COMP_WORDS[COMP_CWORD - 1]}}" in
{values}
    *)
        case "$path" in
{words}
        esac
        [[ ${{COMP_WORDS[COMP_CWORD]}} == -* || -n $commands ]] || return 0
        ;;
    esac
    COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _curvireg curvireg
"""


def script(parser: argparse.ArgumentParser, shell: str) -> str:
    """What a shell reads to complete ``curvireg``: commands, options, and their choices; files where they belong.

    Args:
        parser: of the whole command line.
        shell: one of :data:`SHELLS`.
    """
    tables = list(_tables(parser))
    if shell == "fish":
        return "".join(f"{line}\n" for line in _fish(tables))
    start = "autoload -U +X bashcompinit && bashcompinit\n" if shell == "zsh" else ""
    return start + _bash(tables)


def _tables(
    parser: argparse.ArgumentParser, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], dict[str, str], list[argparse.Action]]]:
    """Of every command: its words, its commands with their help, its options."""
    below: dict[str, argparse.ArgumentParser] = {}
    told: dict[str, str] = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            below = dict(action.choices)
            told = {choice.dest: choice.help or "" for choice in action._choices_actions}
    options = [action for action in parser._actions if action.help != argparse.SUPPRESS]
    yield path, {name: told.get(name, "") for name in below}, options
    for name, one in below.items():
        yield from _tables(one, (*path, name))


def _bash(tables: Sequence[tuple[tuple[str, ...], dict[str, str], list[argparse.Action]]]) -> str:
    paths, values, words = [], [], []
    for path, commands, options in tables:
        place = "".join(f" {word}" for word in path)
        paths += [f"        '{place} {name}') path='{place} {name}' ;;" for name in commands]
        for option in options:
            if option.choices and not commands:
                choices = " ".join(map(str, option.choices))
                names = option.option_strings or [path[-1]]  # behind the command stands its first argument
                values += [f"    '{place} {name}') words='{choices}' ;;" for name in names]
        flags = [name for option in options for name in option.option_strings]
        more = " commands=yes" if commands else ""
        words.append(f"        '{place}') words='{' '.join([*commands, *flags])}'{more} ;;")
    return _BASH.format(paths="\n".join(paths), values="\n".join(values), words="\n".join(words))


def _fish(tables: Sequence[tuple[tuple[str, ...], dict[str, str], list[argparse.Action]]]) -> Iterator[str]:
    for path, commands, options in tables:
        seen = [f"__fish_seen_subcommand_from {word}" for word in path]
        when = f" -n {shlex.quote('; and '.join(seen))}" if seen else ""
        if commands:
            none = f"not __fish_seen_subcommand_from {' '.join(commands)}"
            fresh = shlex.quote("; and ".join([*seen, none]))
            for name, told in commands.items():
                yield f"complete -c curvireg -f -n {fresh} -a {name} -d {shlex.quote(told)}"
        for option in options:
            told = shlex.quote((option.help or "").split(";")[0].split(":")[0].replace("%%", "%"))
            choices = " ".join(map(str, option.choices)) if option.choices and not commands else ""
            given = f" -xa {shlex.quote(choices)}" if choices else " -r" if option.nargs != 0 else ""
            for name in option.option_strings:
                flag = f"-l {name[2:]}" if name.startswith("--") else f"-s {name[1:]}"
                yield f"complete -c curvireg{when} {flag}{given} -d {told}"
            if choices and not option.option_strings:
                yield f"complete -c curvireg{when} -f -a {shlex.quote(choices)}"
