"""``python -m curvireg_torch.jobs.launch WORDS`` is ``torchrun WORDS`` without its traceback
and its log.

A process that fails has printed its own message.
"""

import logging
import sys

from torch.distributed.elastic.multiprocessing.api import SignalException
from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
from torch.distributed.run import main

if __name__ == "__main__":
    logging.disable()
    try:
        main(sys.argv[1:])
    except ChildFailedError:
        sys.exit(1)
    except (KeyboardInterrupt, SignalException):
        sys.exit(130)
