"""The entry of the command line: ``curvireg`` and ``python -m curvireg_torch``."""

import gc
import signal
import sys

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # while modules are imported, Ctrl-C ends the process without a trace
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from .cli import main as run


def main() -> int:
    """Run one command, see :func:`curvireg_torch.cli.main`."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # imports make 400,000 objects that stay: look for cycles among them less often
    gc.set_threshold(100_000)
    code = run()
    gc.freeze()  # and not at exit
    return code


if __name__ == "__main__":
    sys.exit(main())
