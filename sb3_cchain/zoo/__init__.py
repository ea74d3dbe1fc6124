"""The command ``sb3-cchain``: RL Zoo's command line with our algorithms, methods and hyperparameters."""

try:
    import rl_zoo3  # noqa: F401
except ImportError as error:
    raise ImportError(f'The sb3-cchain command needs RL Zoo ({error}): pip install "sb3-cchain[zoo]"') from error
