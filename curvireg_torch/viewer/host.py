"""What the parts of the page may ask of the page."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from .session import Session

__all__ = ["Host"]


class Host(Protocol):
    """The page, as its inputs and panels see it."""

    session: Session
    busy: bool  # whether a job is running
    scale: float  # of the displayed photograph to the photograph

    async def run(self, job: Callable[[], Any]) -> Any:
        """Run a job in a thread and show its errors; returns its result or True, None after an error."""

    def serve(self, name: str, content: bytes, media_type: str = "image/png") -> str:
        """Put a file on the server; returns its address, which is new each time."""

    def upload_path(self, prefix: str, suffix: str) -> Path:
        """A new path for an uploaded file."""

    def show_message(self, text: str, *, error: bool = False) -> None:
        """Put a message on the page."""

    def draw(self, svg: str) -> None:
        """Draw shapes over the photograph, in px of the displayed photograph."""

    def update_layers(self) -> None:
        """Show as much of the pose as the sliders say, and nothing without a result."""

    async def show_photograph(self) -> None:
        """Show the photograph of the session with its box and camera."""

    async def show_pose(self, *, new_result: bool = False) -> None:
        """Show the displayed pose of the session."""
