import multiprocessing
import os
import signal
from contextlib import suppress

import pytest
import torch as th

# A shell has the commands that it runs in the background ignore Ctrl-C, which processes that tests start would inherit
signal.signal(signal.SIGINT, signal.default_int_handler)
# Here, because only processes that are started later have them imported
multiprocessing.set_forkserver_preload(["tests.resume_preload"])


with suppress(ImportError):  # before dm_control, which tests import; see sb3_cchain/envs/dm_control.py
    import triton  # noqa: F401


@pytest.fixture(autouse=True, scope="session")
def folder_of_loggers(tmp_path_factory):
    """Of models that log to none. Otherwise SB3 makes one for each in the system's temporary folder, where it stays."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("sb3_logs"))


@pytest.fixture(autouse=True)
def one_thread():
    """As training processes do; also makes sums independent of the machine."""
    th.set_num_threads(1)
