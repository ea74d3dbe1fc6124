"""The command ``sb3-cchain``: RL Zoo's command line with the algorithms, methods and hyperparameters of this package."""
