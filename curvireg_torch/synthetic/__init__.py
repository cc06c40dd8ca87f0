"""Synthetic photographs with known pose, for the demo and for tests."""

from .demo import DemoScene, demo_scene
from .photographs import procedural_background, random_pose, synthesize_photograph
from .tabletop import photograph_tabletop
from .truck import example_mesh

__all__ = [
    "DemoScene",
    "demo_scene",
    "example_mesh",
    "photograph_tabletop",
    "procedural_background",
    "random_pose",
    "synthesize_photograph",
]
