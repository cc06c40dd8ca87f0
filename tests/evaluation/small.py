"""``python -m tests.evaluation.small``: the command with a bank so small that tests are quick, and a way to die.

``CURVIREG_TEST_KILL=n`` kills the process with signal 9 when it is about to give the n-th file its name.
"""

import os
import signal
import sys
from dataclasses import dataclass

from curvireg_torch.evaluation import DEFAULT, PRESETS, Preset
from curvireg_torch.evaluation.__main__ import main
from curvireg_torch.geometry import ViewSphere, sample_views
from curvireg_torch.matching import BankSettings


@dataclass(frozen=True)
class SmallPreset(Preset):
    bank: BankSettings = BankSettings(image_size=32)  # noqa: RUF009 (frozen)
    refine: bool = False

    def views(self, pose: str) -> ViewSphere:
        return sample_views(azimuth_step=60, elevations=[10] if pose == "upright" else [-60, 10, 60])


SMALL = SmallPreset()


def die_at(count: int) -> None:
    """Kill this process at its ``count``-th rename within an evaluation's folder."""
    replace, seen = os.replace, 0

    def replace_or_die(source, target):
        nonlocal seen
        seen += not str(target).endswith(".safetensors")
        if seen == count:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(source, target)

    os.replace = replace_or_die


if __name__ == "__main__":
    PRESETS[DEFAULT] = SMALL
    if "CURVIREG_TEST_KILL" in os.environ:
        die_at(int(os.environ["CURVIREG_TEST_KILL"]))
    sys.exit(main())
