"""``python -m tests.evaluation.small``: the command with a bank so small that tests are quick, and a way to die.

``CURVIREG_TEST_KILL=n`` kills the process with signal 9 when it is about to give the n-th file its name.
"""

import os
import signal
import sys

from curvireg_torch.cli import main
from curvireg_torch.pipeline import DEFAULT, PRESETS, Pipeline
from curvireg_torch.settings import BankSettings, ViewPolicy

SMALL = Pipeline(
    views=ViewPolicy(directions=18, theta_step=360.0, azimuth_step=60.0, elevations=(10.0,)),
    bank=BankSettings(image_size=32),
    terms=PRESETS["classical"].terms,
    search=False,
    contours=False,
)


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
    sys.exit(main(["evaluate", *sys.argv[1:]]))
