"""Processor time inside chosen methods of a training."""

import time
from collections.abc import Callable
from functools import wraps
from typing import Any


class TimeInside:
    """Adds up the processor time that methods take, with what they call. None of them may call another one of them."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def watch(self, owner: object, *names: str) -> None:
        """
        :param owner: An object
        :param names: Names of its methods, whose calls are timed from now on
        """
        for name in names:
            setattr(owner, name, self._timed(getattr(owner, name)))

    def _timed(self, method: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(method)
        def call(*args: Any, **kwargs: Any) -> Any:
            start = time.process_time()
            result = method(*args, **kwargs)
            self.seconds += time.process_time() - start
            return result

        return call
