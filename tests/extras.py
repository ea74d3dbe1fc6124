"""Which tests Python 3.13 cannot run: dm_control and procgen have no wheels for it."""

import sys

import pytest

NO_WHEELS = ("dm_control", "procgen") if sys.version_info >= (3, 13) else ()
needs_dm_control = pytest.mark.skipif("dm_control" in NO_WHEELS, reason="dm_control has no wheels for Python 3.13")
needs_procgen = pytest.mark.skipif("procgen" in NO_WHEELS, reason="procgen has no wheels for Python 3.13")
