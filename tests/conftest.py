"""One thread: nearly all that the tests compute is too small to be shared, and threads that wait cost as much."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported, and for the processes that tests start
