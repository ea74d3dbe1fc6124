import multiprocessing
import signal

import pytest
import torch as th

# A shell has the commands that it runs in the background ignore Ctrl-C, which processes that tests start would inherit
signal.signal(signal.SIGINT, signal.default_int_handler)
# Here, because only processes that are started later have them imported
multiprocessing.set_forkserver_preload(["tests.resume_preload"])


@pytest.fixture(autouse=True)
def one_thread():
    """As training processes do; also makes sums independent of the machine."""
    th.set_num_threads(1)
