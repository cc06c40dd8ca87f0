"""Deprecated place of :mod:`curvireg_torch.pipeline`."""

import warnings

from .pipeline import DEFAULT, FIELDS, PRESETS, Pipeline, preset_named

__all__ = ["DEFAULT", "FIELDS", "PRESETS", "Preset", "preset_named"]

Preset = Pipeline

warnings.warn("curvireg_torch.presets is deprecated; use curvireg_torch.pipeline", DeprecationWarning, stacklevel=2)
