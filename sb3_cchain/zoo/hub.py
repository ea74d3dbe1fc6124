"""RL Zoo's commands for the Hugging Face Hub, with the clients that are installed."""

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import huggingface_hub.repocard
import huggingface_sb3
from huggingface_hub.utils import EntryNotFoundError
from requests.exceptions import HTTPError

from sb3_cchain.replaced import replaced


@contextmanager
def working_clients(gym_packages: Sequence[str] = ()) -> Iterator[None]:
    """
    Inside the ``with`` block RL Zoo's modules ``push_to_hub`` and ``load_from_hub`` find what they expect of the clients, some
    of which newer clients have changed:

    - ``huggingface_sb3`` has renamed ``generate_metadata``.
    - ``huggingface_hub`` no longer raises an error of ``requests`` for a file that is not there, such as the statistics of a
      model without normalisation.

    And the model card says how this package is installed, names its commands, which know its algorithms, and says what was
    evaluated and what to cite.

    :param gym_packages: Packages that the commands on the card import
    """
    push = import_module("huggingface_sb3.push_to_hub")  # the function of that name hides the module
    with ExitStack() as stack:
        if not hasattr(push, "generate_metadata"):
            stack.enter_context(replaced(push, "generate_metadata", push._generate_metadata))
        stack.enter_context(replaced(huggingface_sb3, "load_from_hub", _load_from_hub))
        stack.enter_context(
            replaced(huggingface_hub.repocard, "metadata_save", partial(_save_card, gym_packages=gym_packages))
        )
        yield


# What RL Zoo writes on the card, and what is right here
REPLACEMENTS = (
    (
        "Install the RL Zoo (with SB3 and SB3-Contrib):",
        "Install sb3_cchain, which is not on PyPI yet, in a clone of its repository:",
    ),
    ("If you installed the RL Zoo3 via pip (`pip install rl_zoo3`), from anywhere you can do:", "From anywhere you can do:"),
    ("pip install rl_zoo3", 'pip install ".[zoo]"'),
    ("python -m rl_zoo3.", "sb3-cchain "),
)

MORE = """
## Evaluation
`mean_reward` is the mean return of 10 episodes in the environment from its beginning. Of a continual environment this is its
first task, or the one that `first_task` under "Environment Arguments" names; of another world that changes, the world as it
starts. It says nothing about the other tasks.

## Citation
Tang et al., [Mitigating Plasticity Loss in Continual Reinforcement Learning by Reducing
Churn](https://arxiv.org/abs/2506.00592), ICML 2025
"""

_load, _save_metadata = huggingface_sb3.load_from_hub, huggingface_hub.repocard.metadata_save


def _load_from_hub(repo_id: str, filename: str) -> str:
    try:
        return _load(repo_id, filename)
    except EntryNotFoundError as error:
        raise HTTPError(str(error)) from error


def _save_card(path: Path, metadata: Any, gym_packages: Sequence[str]) -> None:
    card = path.read_text(encoding="utf-8")
    for stock, name in REPLACEMENTS:
        card = card.replace(stock, name)
    if gym_packages:
        card = re.sub("^sb3-cchain .*", rf"\g<0> --gym-packages {' '.join(gym_packages)}", card, flags=re.MULTILINE)
    path.write_text(card + MORE, encoding="utf-8")
    _save_metadata(path, metadata if isinstance(metadata, dict) else metadata.to_dict())
