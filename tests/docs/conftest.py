import pytest

from curvireg_torch import evaluation, pipeline, terms


@pytest.fixture(autouse=True)
def _tables(monkeypatch):
    """What a page adds must not reach other tests."""
    for table in (pipeline.FIELDS, pipeline.DEPTH_FIELDS, terms.TERMS, evaluation.DATASETS):
        for name in table:
            monkeypatch.setitem(table, name, table[name])
