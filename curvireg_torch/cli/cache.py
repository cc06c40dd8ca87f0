"""``curvireg cache [--clear]``."""

import argparse
import time
from typing import Any

from .options import common_options, examples


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "cache",
        parents=[common_options()],
        help="list or clear the banks cached on disk",
        **examples("curvireg cache", "curvireg cache --clear"),
    )
    parser.add_argument("--clear", action="store_true", help="remove them all")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """List the cached banks, or remove them."""
    from ..matching import cache_folder, clear_cache, list_cache

    if arguments.clear:
        print(f"{cache_folder()}: {clear_cache()} banks removed")
        return
    banks = list_cache()
    for bank in banks:
        used = time.strftime("%Y-%m-%d %H:%M", time.localtime(bank.used))
        print(f"{bank.size / 1e6:8.1f} MB   last used {used}   {bank.path.name}")
    print(f"{cache_folder()}: {len(banks)} banks, {sum(bank.size for bank in banks) / 1e6:.1f} MB")
