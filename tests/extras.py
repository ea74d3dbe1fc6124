"""Tests of what needs a package without wheels for Python 3.13."""

from importlib.util import find_spec

import pytest

needs_dm_control = pytest.mark.skipif(find_spec("dm_control") is None, reason="dm_control is not installed")
needs_procgen = pytest.mark.skipif(find_spec("procgen") is None, reason="procgen is not installed")
