"""What a command is doing."""

from collections.abc import Iterator
from contextlib import contextmanager

from ..utils.aliases import Progress

STAGES = {
    "detection": "detecting the object",
    "mesh": "reading the mesh",
    "bank": "rendering views",
    "contours": "fitting contours",
}
"""Stages that are called otherwise than in the library."""


@contextmanager
def shown_stages(*, shown: bool) -> Iterator[Progress]:
    """Context with a function that shows on a terminal how much of a stage is done."""
    from tqdm import tqdm

    # None: where there is no terminal
    with tqdm(total=1, leave=False, disable=None if shown else True) as bar:
        current = ""

        def show(stage: str, done: int, total: int) -> None:
            nonlocal current
            if stage != current:
                current = stage
                bar.reset()
                bar.set_description(STAGES.get(stage, stage), refresh=False)
            bar.total = total
            bar.update(done - bar.n)
            bar.refresh()

        show("mesh", 0, 1)
        yield show
