"""Examples below the help of a command."""

import argparse
from typing import TypedDict


class _Below(TypedDict):
    epilog: str
    formatter_class: type[argparse.HelpFormatter]


class _Formatter(argparse.HelpFormatter):
    """Wraps all but examples."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if not text.startswith("examples:"):
            return super()._fill_text(text, width, indent)
        return "".join(indent + line for line in text.splitlines(keepends=True))


def examples(*lines: str) -> _Below:
    """For ``ArgumentParser``: these command lines below its help."""
    return {"epilog": "\n  ".join(["examples:", *lines]), "formatter_class": _Formatter}
