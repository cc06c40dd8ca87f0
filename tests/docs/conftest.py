"""Fixtures of the documentation's tests."""

import pytest

from curvireg_torch import detectors, evaluation, pipeline, rendering, settings, terms


@pytest.fixture(autouse=True)
def _registries(monkeypatch):
    """What a page registers must not reach other tests."""
    registries = (pipeline.FIELDS, settings.DEPTH_FIELDS, terms.TERMS, rendering.BACKENDS, evaluation.DATASETS)
    for registry in (*registries, detectors.DETECTORS):
        monkeypatch.setattr(registry, "_entries", dict(registry._entries))
