"""Checks that optimisers which act on weight matrices leave alone what they are to leave alone."""

import re

from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from sb3_cchain.methods.optimizer_wrapper import nested_wrappers
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.injection_policies import Injectable
from sb3_cchain.networks.model_optimizers import model_optimizers

# Modules of the policies of SB3 and sb3-contrib that end in, or are, an output layer
_HEADS = re.compile(r"action_net|value_net|actor\.mu|actor\.log_std|critic\.qf\d+|q_net\.q_net|quantile_net\.quantile_net")
# A parameter of its own, and with gSDE a matrix
_LOG_STD = re.compile(r"(actor\.)?log_std")


def check_output_layers(model: BaseAlgorithm) -> None:
    """
    An optimiser knows parameters only by their order. Here their names are known.

    :param model: A model
    :raises ValueError: When an optimiser of this package acts on an output layer although ``n_output_layers`` is not 0, or
        takes the ``log_std`` of gSDE for weights
    """
    policy = uncompiled(model.policy)
    names = {id(parameter): name for name, parameter in policy.named_parameters()}
    outputs = output_weights(policy)
    for optimizer in model_optimizers(model).values():
        for wrapper in nested_wrappers(optimizer):
            kind = type(wrapper).__name__
            acts_on = [names[id(weight)] for weight in wrapper.matrices() if id(weight) in names]
            n_output_layers = getattr(wrapper, "n_output_layers", 0)
            touched = [name for name in acts_on if name in outputs]
            if n_output_layers > 0 and touched:
                raise ValueError(
                    f"{kind} leaves the last weight matrices alone, as many as `n_output_layers`, got {n_output_layers}. With "
                    f"that it acts on output layers of {type(model).__name__}: {', '.join(touched)}. The order is "
                    f"{', '.join(names[id(weight)] for weight in wrapper.weights() if id(weight) in names)}. Where no number "
                    f"fits, {kind} cannot be used; 0 lets it act on all of them."
                )
            if any(_LOG_STD.fullmatch(name) for name in acts_on):
                raise ValueError(
                    f"{kind} takes the `log_std` of gSDE, which is a matrix, for weights of the network: leave `use_sde=False`"
                )


def output_weights(policy: nn.Module) -> set[str]:
    """
    :param policy: A policy of SB3 or sb3-contrib
    :return: The names of its output layers' weights, as far as they are known
    """
    found = set()
    for name, module in policy.named_modules():
        if _HEADS.fullmatch(name):
            name, module = _last_layer(name, module)
            if not isinstance(module, (nn.Linear, Injectable)):
                continue  # not known
            found |= {each for each, parameter in module.named_parameters(prefix=name) if parameter.dim() > 1}
    return found


def _last_layer(name: str, module: nn.Module) -> tuple[str, nn.Module]:
    while isinstance(module, nn.Sequential):
        children = [(child, each) for child, each in module.named_children() if list(each.parameters())]
        if not children:
            break
        name, module = f"{name}.{children[-1][0]}", children[-1][1]
    return name, module
