"""The command ``sb3-cchain``: RL Zoo's command line with our algorithms, methods and hyperparameters."""
