"""What ``train()`` logs, whatever its logger makes of it."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.logger import Logger

from sb3_cchain.replaced import replaced


@contextmanager
def recorded(logger: Logger) -> Iterator[dict[str, Any]]:
    """
    :param logger: A model's logger. One that is not SB3's own may keep values under other names, or pass them on
    :return: The values that are given to its ``record()`` inside the ``with`` block, by the names that are given
    """
    values: dict[str, Any] = {}
    record = logger.record

    def keep(key: str, value: Any, *args: Any, **kwargs: Any) -> None:
        values[key] = value
        record(key, value, *args, **kwargs)

    with replaced(logger, "record", keep):
        yield values
