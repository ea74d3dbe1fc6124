"""
The command ``sb3-cchain`` in a process that does not outlive its parent: ``python -m benchmarks.child PARENT train ...``, with
the parent's process id. Without it, a training run whose parent was killed (kill -9, the out-of-memory killer) would go on for
hours on a core that its successor needs. Linux alone offers it.
"""

import ctypes
import os
import signal
import sys

from sb3_cchain.zoo.cli import main

PR_SET_PDEATHSIG = 1  # linux/prctl.h

if __name__ == "__main__":
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != int(sys.argv[1]):
            sys.exit("the parent died first")
    sys.argv = ["sb3-cchain", *sys.argv[2:]]
    main()
