"""How much memory one epoch of PPO needs with a rollout of 64 × 256 images."""

from typing import Any

from stable_baselines3 import PPO

from benchmarks.speed.big_rollout import N_ENVS, N_STEPS, in_process, peak_memory, with_rollout
from benchmarks.speed.tables import Table
from sb3_cchain import CChainPPO

# Divides the rollout; the shipped 125 would leave a smaller minibatch at the end
BATCH_SIZE = 128

# Every update after the first needs the same
N_UPDATES = 4

# Algorithm, file of hyperparameters, arguments that differ
MODELS: dict[str, tuple[type[PPO], str, dict[str, Any]]] = {
    "PPO": (PPO, "ppo", {}),
    "CChainPPO": (CChainPPO, "ppo_cchain", {}),
    'CChainPPO, `churn_reference="next"`': (CChainPPO, "ppo_cchain", {"churn_reference": "next"}),
}


class Enough(Exception):
    """Ends a ``train()``."""


def memory_table() -> Table:
    """
    :return: For each model, the memory of a process without and with ``train()``
    """
    rows = []
    for name, arguments in MODELS.items():
        without, with_training = (in_process(memory, *arguments, n_updates) for n_updates in (0, N_UPDATES))
        rows.append([name, f"{without:.2f} GB", f"{with_training:.2f} GB", f"{with_training - without:.2f} GB"])
    note = (
        f"The greatest resident memory of a process with the IMPALA network, a rollout of {N_ENVS} × {N_STEPS} random images "
        f"and minibatches of {BATCH_SIZE}. `train()` is stopped after {N_UPDATES} updates."
    )
    return Table(["", "rollout alone", "with `train()`", "difference"], rows, note)


def memory(algorithm: type[PPO], algo: str, changed: dict[str, Any], n_updates: int) -> float:
    """
    :param algorithm: Algorithm
    :param algo: Name of its file of hyperparameters
    :param changed: Arguments that differ
    :param n_updates: Updates of ``train()``
    :return: The greatest resident memory of this process, in GB
    """
    model = with_rollout(algorithm, algo, batch_size=BATCH_SIZE, **changed)
    if n_updates:
        start_train(model, n_updates)
    return peak_memory()


def start_train(model: PPO, n_updates: int) -> None:
    """
    :param model: A model with a rollout
    :param n_updates: Updates after which its ``train()`` is stopped
    :raises RuntimeError: When it has no more than these
    """
    n_done = 0

    def stop(*_: Any) -> None:
        nonlocal n_done
        if n_done == n_updates:
            raise Enough
        n_done += 1

    hook = model.policy.optimizer.register_step_pre_hook(stop)
    try:
        model.train()
    except Enough:
        return
    finally:
        hook.remove()
    raise RuntimeError(f"train() has only {n_done} updates")
