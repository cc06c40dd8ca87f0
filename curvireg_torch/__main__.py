"""The entry of the command line: ``curvireg`` and ``python -m curvireg_torch``."""

import atexit
import gc
import os
import signal
import sys

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # while modules are imported, Ctrl-C ends the process without a trace
    signal.signal(signal.SIGINT, signal.SIG_DFL)

_codes: list[int] = []


@atexit.register  # before other modules: the first that is registered is called last
def _end() -> None:
    """End the process with the code of its command, if that has returned one: Python would take
    2,000 modules apart before, and torch its libraries, which takes 0.2 s."""
    if _codes:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:  # it may have been closed from the beginning
                stream.flush()
        os._exit(_codes[0])


from .cli import main as run  # noqa: E402


def main() -> int:
    """Run one command, see :func:`curvireg_torch.cli.main`."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # imports make many objects that stay: look for cycles among them less often
    gc.set_threshold(100_000)
    return run()


def start() -> int:
    """Run one command as the only work of this process."""
    _codes.append(main())
    return _codes[0]


if __name__ == "__main__":
    sys.exit(start())
