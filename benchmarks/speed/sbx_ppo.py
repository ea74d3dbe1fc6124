"""
SBX's PPO (https://github.com/araffin/sbx), the same algorithm in JAX, in a process of its own: with JAX loaded, PyTorch takes
4 % longer. The two processes run in turn.
"""

import multiprocessing
import os
from importlib.util import find_spec
from multiprocessing.connection import Connection
from typing import Any

import torch as th
from torch import nn

from benchmarks.speed.settings import model_settings
from benchmarks.speed.training import iteration

# One thread, as PyTorch has
XLA_FLAGS = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


def is_installed() -> bool:
    """
    :return: Whether SBX can be imported
    """
    return find_spec("sbx") is not None


class SBXProcess:
    """
    A process that trains SBX's PPO when it is told to.

    :param env_id: Environment id
    :param changed: Arguments that differ from the shipped settings of PPO
    """

    def __init__(self, env_id: str, **changed: Any):
        context = multiprocessing.get_context("spawn")
        self.connection, connection = context.Pipe()
        self.process = context.Process(target=_serve, args=(connection, env_id, changed), daemon=True)
        self.process.start()
        connection.close()
        self.connection.recv()  # when it has compiled

    def iteration(self) -> dict[str, float]:
        """
        :return: Seconds of ``train()`` and of the whole iteration
        """
        self.connection.send(None)
        return self.connection.recv()


def _serve(connection: Connection, env_id: str, changed: dict[str, Any]) -> None:
    os.environ["XLA_FLAGS"] = XLA_FLAGS
    th.set_num_threads(1)
    model = make_sbx_ppo(env_id, **changed)
    iteration(model)  # compiles
    connection.send(None)
    while True:
        try:
            connection.recv()
        except EOFError:
            return
        connection.send(iteration(model))


def make_sbx_ppo(env_id: str, **changed: Any) -> Any:
    """
    :param env_id: Environment id
    :param changed: Arguments that differ from the shipped settings of PPO
    :return: SBX's PPO with the same networks, rollout, minibatches, epochs and learning rate
    """
    import jax
    import sbx

    class SBXPPO(sbx.PPO):
        def train(self) -> None:
            super().train()
            # JAX returns before the last update is computed
            jax.block_until_ready((self.policy.actor_state, self.policy.vf_state))

    settings = model_settings("ppo", env_id, **changed)
    policy_kwargs = settings["policy_kwargs"]
    policy_kwargs["activation_fn"] = flax_activation(policy_kwargs["activation_fn"]())
    if "optimizer_kwargs" in policy_kwargs:
        policy_kwargs["optimizer_kwargs"].pop("fused")
    return SBXPPO(**settings)


def flax_activation(module: nn.Module) -> Any:
    """
    :param module: PyTorch's activation
    :return: Flax's
    :raises TypeError: For one that the shipped settings do not have
    """
    import flax.linen as flax

    if isinstance(module, nn.ReLU):
        return flax.relu
    if isinstance(module, nn.LeakyReLU):
        return lambda x: flax.leaky_relu(x, module.negative_slope)
    raise TypeError(f"No activation of Flax is known for {module}")
