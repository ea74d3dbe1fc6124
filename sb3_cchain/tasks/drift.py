"""Notices that a quantity has become worse."""

import pickle
from typing import Any

from sb3_cchain.validation import check_choice, check_number

DETECTORS = ("adwin",)
DIRECTIONS = ("smaller", "greater")


class Drift:
    """
    Watches a series of values, one at a time.

    The detector is ADWIN of ``river``, asked after each value. It needs at least ten values, five of them since the change.
    After an alarm it starts over.

    :param detector: ``"adwin"``
    :param delta: δ of ADWIN, greater than 0 and less than 1
    :param worse: Which values are worse: ``"smaller"`` or ``"greater"`` ones. A change to better values is not told
    :raises ValueError: Naming the argument that is out of its range
    :raises ImportError: When ``river`` is not installed
    """

    def __init__(self, detector: str = "adwin", delta: float = 0.002, worse: str = "smaller"):
        check_choice("drift", detector, DETECTORS)
        check_number("drift_delta", delta, 0, exclusive=True, below=1)
        check_choice("worse", worse, DIRECTIONS)
        self.delta = delta
        self.worse = worse
        self.reset()

    def reset(self) -> None:
        """Forget all values."""
        self._adwin = _import_adwin()(delta=self.delta, clock=1)

    def update(self, value: float) -> bool:
        """
        :param value: The next value
        :return: Whether the values have become worse
        """
        before = self._adwin.estimation
        self._adwin.update(value)
        if not self._adwin.drift_detected:
            return False
        after = self._adwin.estimation
        has_become_worse = after < before if self.worse == "smaller" else after > before
        if has_become_worse:
            self.reset()
        return has_become_worse

    def state_dict(self) -> dict[str, Any]:
        """
        :return: The window of values
        """
        return {"adwin": pickle.dumps(self._adwin)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: What :meth:`state_dict` returned
        """
        self._adwin = pickle.loads(state["adwin"])


def _import_adwin() -> Any:
    try:
        from river.drift import ADWIN
    except ImportError as error:
        raise ImportError('Drift is detected by the package river. It comes with: pip install "sb3-cchain[drift]"') from error
    return ADWIN
