"""``torchrun --nproc-per-node K -m curvireg_torch.evaluation pascal3d|bop ROOT --out DIR``."""

import argparse
import sys

from .._choices import BACKENDS
from ..errors import CurviregError
from .command import add_datasets


def main() -> int:
    """Entry point; returns the exit code: 0, or 2 for input that cannot be used."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--quiet", action="store_true", help="no progress bar")
    common.add_argument("--renderer", choices=BACKENDS, default="auto", help="default: auto")
    parser = argparse.ArgumentParser(
        prog="python -m curvireg_torch.evaluation", description="Register and score a dataset."
    )
    add_datasets(parser.add_subparsers(required=True, metavar="DATASET"), [common])
    arguments = parser.parse_args()
    try:
        arguments.run(arguments)
    except CurviregError as error:
        print(f"curvireg_torch.evaluation: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
