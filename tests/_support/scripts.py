"""Paths of the repository and its scripts."""

from pathlib import Path

__all__ = ["ROOT", "SCRIPTS"]

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "scripts"
