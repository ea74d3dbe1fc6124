"""Measures the package; imports it, never the reverse."""

import sb3_cchain  # noqa: F401  # before Stable-Baselines3, to silence the notice of the old gym
