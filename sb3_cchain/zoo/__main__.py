"""The console script ``sb3-cchain``, also ``python -m sb3_cchain.zoo``."""

import os
import sys

from sb3_cchain import __version__

COMMANDS = {
    "train": "train an agent, with checkpoints; -optimize searches hyperparameters",
    "enjoy": "watch a trained agent",
    "inspect": "say whether a saved model has lost plasticity, or is ill in another way",
    "record_video": "film a trained agent",
    "record_training": "film how an agent becomes better",
    "compare": "compare methods by their returns on the tasks: a table, and learning curves",
    "plot_train": "plot the returns of training",
    "all_plots": "compare the evaluations of several runs",
    "plot_from_file": "plot what all_plots has saved",
    "benchmark": "evaluate all models of a folder",
    "load_from_hub": "download a model from the Hugging Face Hub",
    "push_to_hub": "upload a model to the Hugging Face Hub",
}
USAGE = f"""usage: sb3-cchain COMMAND ...

RL Zoo's command line, with the algorithms, methods, environments and settings of sb3_cchain {__version__}.

{chr(10).join(f"  {name:16} {text}" for name, text in COMMANDS.items())}

  sb3-cchain train --algo ppo_cchain --env Continual/Acrobot-v1 -P
  sb3-cchain COMMAND --help      options of a command: those of RL Zoo, and for train more
  sb3-cchain --version"""


def main() -> None:
    """
    Run the command that ``sys.argv`` names. RL Zoo is imported for commands only, and where it is missing, one line says so.
    """
    command = sys.argv[1] if len(sys.argv) > 1 else None
    if command in ("-h", "--help"):
        print(USAGE)
    elif command == "--version":
        print(f"sb3-cchain {__version__}")
    elif command not in COMMANDS:
        sys.exit(USAGE if command is None else f"sb3-cchain: COMMAND must be one of {', '.join(COMMANDS)}; got {command}")
    else:
        try:
            from sb3_cchain.zoo import cli
        except ImportError as error:
            sys.exit(f"sb3-cchain: {error}")
        # As with `python -m`: modules of --gym-packages may lie in the present folder
        sys.path.append(os.getcwd())
        cli.run(command)


if __name__ == "__main__":
    main()
