"""Choices within segments, against loops."""

import pytest
import torch

from curvireg_torch.utils.segments import best_within, order_within, place_within


def table(seed):
    """Scores with ties, and segments of which some have no rows."""
    generator = torch.Generator().manual_seed(seed)
    count = 1 + 7 * seed
    scores = torch.randint(0, 4, (count,), generator=generator).double()
    return scores, torch.randint(0, 6, (count,), generator=generator)


def ordered(scores, segment):
    """The rows of each segment that has some, best first."""
    rows = {}
    for row, number in enumerate(segment.tolist()):
        rows.setdefault(number, []).append(row)
    return [sorted(rows[number], key=lambda row: (-scores[row], row)) for number in sorted(rows)]


@pytest.mark.parametrize("seed", range(6))
def test_choices_are_those_of_loops(seed):
    scores, segment = table(seed)
    expected = ordered(scores, segment)
    assert order_within(scores, segment).tolist() == [row for rows in expected for row in rows]
    assert best_within(scores, segment).tolist() == [rows[0] for rows in expected]
    places = {row: place for rows in expected for place, row in enumerate(rows)}
    found = place_within(scores, segment).tolist()
    assert found == [places[row] for row in range(len(scores))]


def test_no_rows_are_no_choice():
    nothing = torch.zeros(0)
    for choice in (order_within, place_within, best_within):
        assert len(choice(nothing, nothing.long())) == 0
