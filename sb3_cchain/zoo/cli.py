"""
The command ``sb3-cchain train|enjoy|plot_train|all_plots|plot_from_file``: RL Zoo's own commands, which know our
algorithms and the related methods and find our hyperparameters; and ``sb3-cchain inspect``.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm

try:
    import rl_zoo3.cli
    import rl_zoo3.exp_manager
    from rl_zoo3 import ALGOS
except ImportError as error:
    raise ImportError(f'The sb3-cchain command needs RL Zoo ({error}): pip install "sb3-cchain[zoo]"') from error

from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN
from sb3_cchain.envs import TaskVecNormalize
from sb3_cchain.zoo import inspect as zoo_inspect
from sb3_cchain.zoo.search import GRIDS, register_search_spaces

OUR_ALGOS: dict[str, type[BaseAlgorithm]] = {"ppo_cchain": CChainPPO, "dqn_cchain": CChainDQN, "double_dqn": DoubleDQN}

# The related methods are settings of an algorithm, under a name of their own
METHODS = {
    "ppo_oracle": "ppo",
    "ppo_trac": "ppo",
    "ppo_weight_clipping": "ppo",
    "ppo_l2_init": "ppo",
    "ppo_layer_norm": "ppo",
    "ppo_redo": "ppo",
    "ppo_adam_rel": "ppo",
    "double_dqn_oracle": "double_dqn",
}


def register_algorithms() -> None:
    """
    Make our algorithms and the related methods known to RL Zoo, in place, and let ``normalize: ...`` in a YAML file restart at
    each task (``restart=False`` in it does not). Where there are no tasks it is SB3's ``VecNormalize``.
    """
    rl_zoo3.exp_manager.VecNormalize = TaskVecNormalize  # type: ignore[misc]
    ALGOS.update(OUR_ALGOS)
    ALGOS.update({method: ALGOS[algo] for method, algo in METHODS.items()})
    register_search_spaces()


def hyperparams_folder() -> Path:
    """
    :return: The folder of our YAML files: inside the installed package, at the root of a checkout
    """
    package = Path(__file__).parent.parent
    inside = package / "zoo_hyperparams"
    return inside if inside.is_dir() else package.parent / "zoo_hyperparams"


def hyperparams_file(algo: str, env_id: str) -> Path | None:
    """
    :param algo: Name of the algorithm on the command line
    :param env_id: Environment id
    :return: Our YAML file, where we have settings for the environment or where the algorithm is ours; otherwise None,
        and RL Zoo's settings hold
    """
    path = hyperparams_folder() / f"{algo}.yml"
    if path.is_file() and (algo in OUR_ALGOS or env_id in _settings(path)):
        return path
    return None


def _settings(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text())


def with_our_hyperparams(arguments: list[str]) -> list[str]:
    """
    :param arguments: Arguments of RL Zoo's ``train``
    :return: The same, with our YAML file where we have one
    :raises SystemExit: When a related method has no settings for the environment, or is to be optimised and has nothing that
        could be
    """
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo", default="ppo")
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("-optimize", "--optimize-hyperparameters", action="store_true")
    given, _ = parser.parse_known_args(arguments)
    ours = hyperparams_file(given.algo, given.env)
    if given.algo in METHODS:
        if given.optimize_hyperparameters and given.algo not in GRIDS:
            sys.exit(
                f"-optimize: {given.algo} has no hyperparameters of its own to search. "
                f"Those of {METHODS[given.algo]} are searched by --algo {METHODS[given.algo]} -optimize."
            )
        if ours is None and given.conf_file is None:
            covered = [key for key in _settings(hyperparams_folder() / f"{given.algo}.yml") if not key.endswith("-defaults")]
            sys.exit(
                f"{given.algo}.yml has no settings for {given.env}, only for {', '.join(covered)}. "
                "For another environment, give a YAML file of your own: -conf FILE"
            )
    # First, so that a file given by the user wins
    return arguments if ours is None else ["--conf-file", str(ours), *arguments]


def main() -> None:
    """Run RL Zoo's command line."""
    commands = ["train", "enjoy", "inspect", "plot_train", "all_plots", "plot_from_file"]
    if len(sys.argv) < 2 or sys.argv[1] not in commands:
        sys.exit(
            f"usage: sb3-cchain {{{'|'.join(commands)}}} ...\n"
            "The options are those of RL Zoo: sb3-cchain train --help. inspect is ours: sb3-cchain inspect --help"
        )
    register_algorithms()
    if sys.argv[1] == "inspect":
        return zoo_inspect.main(sys.argv[2:])
    if sys.argv[1] == "train":
        sys.argv[2:] = with_our_hyperparams(sys.argv[2:])
    rl_zoo3.cli.main()


if __name__ == "__main__":
    main()
