"""
A command in a process that does not outlive its parent: ``python child.py PARENT COMMAND ...``, with the parent's process id.
Without it, a training run whose parent was killed (kill -9, the out-of-memory killer) would go on for hours on a core that the
next attempt needs. Only Linux offers it.
"""

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1  # linux/prctl.h; kept by exec

if __name__ == "__main__":
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != int(sys.argv[1]):
            sys.exit("the parent died first")
    os.execv(sys.argv[2], sys.argv[2:])
