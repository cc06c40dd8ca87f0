"""Tables of tests, as text, and values by their names."""

import json
from contextlib import suppress

import torch


def text_table(text):
    """The rows of a table with bars between its cells: what JSON reads there, else texts."""
    return [tuple(map(_value, row.split("|"))) for row in text.strip().splitlines()]


def check_values(document, **expected):
    """Check these values of a document or a sample; those of tensors are lists."""
    for name, value in expected.items():
        found = document[name]
        if isinstance(found, torch.Tensor):
            found = found.tolist()
        assert found == value, f"{name}: {found}"


def check_columns(rows, **expected):
    """Check these columns of a table, as :func:`check_values`."""
    check_values({name: [row[name] for row in rows] for name in expected}, **expected)


def _value(cell):
    with suppress(ValueError):
        return json.loads(cell)
    return cell.strip()
