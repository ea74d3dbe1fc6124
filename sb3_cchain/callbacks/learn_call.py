"""Whether a call of ``learn()`` is over: Stable-Baselines3 does not tell callbacks when an error or Ctrl-C ends it."""

import sys
import threading


class LearnCall:
    """
    The call of ``learn()`` that this thread is in, when the object is made.
    """

    def __init__(self) -> None:
        self._thread = threading.get_ident()
        self._frame = sys._getframe()
        while self._frame.f_code.co_name != "learn" and self._frame.f_back is not None:
            self._frame = self._frame.f_back

    def is_over(self) -> bool:
        """
        :return: Whether its thread has left it. Any thread may ask
        """
        frame = sys._current_frames().get(self._thread)
        while frame is not None and frame is not self._frame:
            frame = frame.f_back
        return frame is None
