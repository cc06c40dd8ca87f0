"""Tables of tests, as text."""

import json
from contextlib import suppress


def text_table(text):
    """The rows of a table with bars between its cells: what JSON reads there, else texts."""
    return [tuple(map(_value, row.split("|"))) for row in text.strip().splitlines()]


def _value(cell):
    with suppress(ValueError):
        return json.loads(cell)
    return cell.strip()
