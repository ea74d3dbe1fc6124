"""
The processes of ``SubprocVecEnv``. Ctrl-C in a terminal and the signals of a cluster reach them, too, and would end them while
the training process still needs them, to complete its rollout and to save.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Sequence
from multiprocessing.process import BaseProcess
from multiprocessing.util import Finalize
from types import FrameType
from weakref import WeakSet

from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

# The environments of this process that have been told
_told: WeakSet[SubprocVecEnv] = WeakSet()


def live_as_long_as_training(env: VecEnv) -> None:
    """
    Have the processes of environments live until they are closed or this process ends, whatever signal they get.

    :param env: A vectorised environment, perhaps one without processes
    """
    base = env.unwrapped
    if not isinstance(base, SubprocVecEnv) or base in _told:
        return
    # SB3 calls methods of environments only
    base.set_attr("live_as_long_as_parent", _live_as_long_as_parent)
    base.env_method("live_as_long_as_parent")
    # Where they are not closed, multiprocessing ends them by SIGTERM when this process ends, and waits for them. Finalizers
    # come before that
    Finalize(None, _kill, args=(base.processes,), exitpriority=0)
    _told.add(base)


def _kill(processes: Sequence[BaseProcess]) -> None:
    for process in processes:
        if process.is_alive():
            process.kill()


def _live_as_long_as_parent() -> None:
    """For the process of an environment."""
    for number in (signal.SIGINT, signal.SIGTERM):
        # Not by SIG_IGN, which a program that an environment starts would inherit
        signal.signal(number, _take_no_notice)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _take_no_notice(number: int, frame: FrameType | None) -> None:
    pass


def _end_with_parent() -> None:
    # A closed pipe does not tell that the parent is gone: after a fork, other environments' processes have it open, too
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(0)
