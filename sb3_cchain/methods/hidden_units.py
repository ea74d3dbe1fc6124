"""Which weights lead into and out of each hidden unit of a network."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypeGuard

import torch as th
from torch import nn

from sb3_cchain.analysis.metrics.dormancy import mean_activity
from sb3_cchain.networks.activations import ELEMENTWISE_ACTIVATIONS, CReLU, FourierFeatures
from sb3_cchain.networks.forward_hooks import forward_hooks
from sb3_cchain.networks.layers import LAYERS


@dataclass
class HiddenUnits:
    """
    The units of a hidden layer, for a convolution its filters. All of their outgoing weights are known.

    Modules are named as in ``network.named_modules()``. A *source* tells for each input channel of a module which unit of the
    layer it is; -1 stands for none of them.

    :param layer: The linear or convolutional layer
    :param n_units: Number of units
    :param outgoing: The layers that the units feed, with their sources
    :param norms: The LayerNorms between, with the sources of their parameters
    :param has_weights: Whether ``layer`` names a module, in which each unit has incoming weights of its own
    """

    layer: str
    n_units: int
    outgoing: dict[str, th.Tensor]
    norms: dict[str, th.Tensor]
    has_weights: bool = True

    def is_trained(self, network: nn.Module) -> bool:
        """
        :param network: The network
        :return: Whether none of the weights into and out of the units is frozen
        """
        modules = [*([self.layer] if self.has_weights else []), *self.norms, *self.outgoing]
        return all(parameter.requires_grad for name in modules for parameter in network.get_submodule(name).parameters())


def find_hidden_units(network: nn.Module, run: Callable[[], Any]) -> list[HiddenUnits]:
    """
    Find the hidden layers by sending a tag of each unit through the network instead of its output: a number that no other unit
    has, the same at all positions. Activations and LayerNorms let the tags pass; pooling, transposing, flattening and
    concatenation keep them; so the inputs of the next layer show which unit each of them is, however channels were flattened.
    A sum, as in a residual connection, is no tag any more; its gradient with respect to the tags tells which units are in it.

    A layer is left out when any of its units feeds something other than a known place in a linear or convolutional layer: when
    it is added to a residual stream, is an output, or is followed by grouped convolutions or modules that are not known here.

    :param network: The network, in evaluation mode
    :param run: Calls it on a batch of one observation of zeros, which cannot be mistaken for tags
    :return: The layers, in the order of ``network.named_modules()``
    """
    names = {module: name for name, module in network.named_modules()}
    layers = [module for module in names if _is_layer(module)]
    sizes = [layer.weight.shape[0] for layer in layers]
    # Above 1, the greatest number in an encoded observation of zeros, and below 2, so that no sum of tags equals a tag
    tags = [
        (1 + unit * 2.0**-22).to(layer.weight).requires_grad_()
        for layer, unit in zip(layers, th.arange(1, sum(sizes) + 1).split(sizes), strict=True)
    ]
    arrived = _send_tags(names, dict(zip(layers, tags, strict=True)), run)
    all_tags = th.cat(tags).detach()
    sources = {module: _read(all_tags, tagged) for module, tagged in arrived.items()}
    elsewhere = th.zeros(len(all_tags), dtype=th.bool, device=all_tags.device)
    for module in layers:
        if module in arrived and arrived[module].requires_grad:
            elsewhere |= _feeds_more(arrived[module], sources[module], tags)

    found, first = [], 0
    for layer, size in zip(layers, sizes, strict=True):
        layer_sources = {
            module: th.where((source >= first) & (source < first + size), source - first, -1)
            for module, source in sources.items()
        }
        reached = {names[module]: source for module, source in layer_sources.items() if (source >= 0).any()}
        outgoing = {name: source for name, source in reached.items() if _is_layer(network.get_submodule(name))}
        norms = {name: source for name, source in reached.items() if name not in outgoing}
        if outgoing and not elsewhere[first : first + size].any():
            found.append(HiddenUnits(names[layer], size, outgoing, norms))
        first += size
    return found


def _send_tags(
    modules: Iterable[nn.Module], tag_of: Mapping[nn.Module, th.Tensor], run: Callable[[], Any]
) -> dict[nn.Module, th.Tensor]:
    """
    :param modules: All modules of a network
    :param tag_of: For each of its layers the tags of the units, which it gives out instead of its outputs
    :param run: Calls the network
    :return: What arrives at each layer, ``(batch and positions, channels)``, and at each LayerNorm that has parameters
    """
    arrived: dict[nn.Module, th.Tensor] = {}

    def send_tags(module: nn.Module, inputs: tuple[th.Tensor, ...], output: th.Tensor) -> th.Tensor | None:
        if module in tag_of:
            arrived[module] = _channels_last(module, inputs[0])
            tagged = tag_of[module].expand(*output.movedim(_channel_dim(module), -1).shape).movedim(-1, _channel_dim(module))
            return tagged.clone()  # for activations that write into their inputs
        if isinstance(module, (CReLU, FourierFeatures)):
            return th.cat([inputs[0], inputs[0]], dim=1)
        if isinstance(module, nn.LayerNorm) and module.elementwise_affine:
            arrived[module] = inputs[0].reshape(-1, *module.normalized_shape)[0].flatten()[None]
        return inputs[0] if isinstance(module, (*ELEMENTWISE_ACTIVATIONS, nn.Dropout, nn.LayerNorm)) else None

    with forward_hooks(modules, send_tags), th.enable_grad():
        run()
    return arrived


def find_flattened_units(network: nn.Module, run: Callable[[], Any]) -> list[HiddenUnits]:
    """
    :param network: The network, in evaluation mode
    :param run: Calls it on a batch of one observation of zeros
    :return: For each linear layer that follows a convolution, its inputs as the units of a layer without weights of its own,
        called ``<linear layer>.inputs``
    """
    names = {module: name for name, module in network.named_modules() if _is_layer(module)}
    order: list[nn.Module] = []
    with forward_hooks(names, lambda module, inputs, output: order.append(module)), th.no_grad():
        run()
    found = {}
    for before, layer in pairwise(order):
        if isinstance(layer, nn.Linear) and not isinstance(before, nn.Linear):
            source = th.arange(layer.in_features, device=layer.weight.device)
            found[layer] = HiddenUnits(f"{names[layer]}.inputs", layer.in_features, {names[layer]: source}, {}, False)
    return list(found.values())


def received_activity(
    network: nn.Module,
    layers: list[HiddenUnits],
    run: Callable[[], Any],
    measure: Callable[[th.Tensor], th.Tensor] = mean_activity,
) -> dict[str, th.Tensor]:
    """
    :param network: The network
    :param layers: Its hidden units
    :param run: Calls it on a batch of observations
    :param measure: Of the activations ``(batch and positions, channels)``, to ``(channels,)``
    :return: For each layer that is fed by the units, the measure of its input channels
    """
    modules = {network.get_submodule(name): name for layer in layers for name in layer.outgoing}
    activity: dict[str, th.Tensor] = {}

    def look(module: nn.Module, inputs: tuple[th.Tensor, ...], output: th.Tensor) -> None:
        activity[modules[module]] = measure(_channels_last(module, inputs[0]))

    with forward_hooks(modules, look), th.no_grad():
        run()
    return activity


def sum_of_places(layer: HiddenUnits, values: dict[str, th.Tensor]) -> th.Tensor:
    """
    :param layer: A hidden layer
    :param values: For each layer that it feeds, a value of each input channel
    :return: For each unit the sum over the channels that it is, ``(n_units,)``
    """
    received = th.cat([values[name][source >= 0] for name, source in layer.outgoing.items()])
    units = th.cat([source[source >= 0] for source in layer.outgoing.values()])
    return received.new_zeros(layer.n_units).index_add(0, units, received)


def hidden_activity(
    network: nn.Module,
    layers: list[HiddenUnits],
    run: Callable[[], Any],
    measure: Callable[[th.Tensor], th.Tensor] = mean_activity,
) -> list[th.Tensor]:
    """
    :param network: The network
    :param layers: Its hidden units
    :param run: Calls it on a batch of observations
    :param measure: As for :func:`received_activity`
    :return: For each layer, the measure of its units ``(n_units,)``, by default
        :func:`~sb3_cchain.analysis.metrics.dormancy.mean_activity`, as the next layers receive them
    """
    activity = received_activity(network, layers, run, measure)
    ones = {name: th.ones_like(value) for name, value in activity.items()}
    return [sum_of_places(layer, activity) / sum_of_places(layer, ones) for layer in layers]


def _is_layer(module: nn.Module) -> TypeGuard[nn.Linear | nn.Conv1d | nn.Conv2d | nn.Conv3d]:
    return isinstance(module, LAYERS) and getattr(module, "groups", 1) == 1


def _channel_dim(module: nn.Module) -> int:
    return -1 if isinstance(module, nn.Linear) else 1


def _channels_last(module: nn.Module, inputs: th.Tensor) -> th.Tensor:
    """Inputs as a matrix ``(batch and positions, channels)``."""
    return inputs.movedim(_channel_dim(module), -1).flatten(end_dim=-2)


def _read(all_tags: th.Tensor, tagged: th.Tensor) -> th.Tensor:
    """The index in ``all_tags`` of each channel, or -1."""
    index = th.searchsorted(all_tags, tagged[0].contiguous()).clamp(max=len(all_tags) - 1)
    return th.where((tagged == all_tags[index]).all(dim=0), index, -1)


def _feeds_more(tagged: th.Tensor, source: th.Tensor, tags: list[th.Tensor]) -> th.Tensor:
    """For each tag, whether these inputs depend on it in any other way than by being it."""
    weights = th.arange(1.0, len(source) + 1, dtype=tagged.dtype, device=tagged.device)
    gradients = th.autograd.grad(tagged.mean(dim=0) @ weights, tags, retain_graph=True, materialize_grads=True)
    known = source >= 0
    expected = th.zeros_like(th.cat(gradients)).index_add(0, source[known], weights[known])
    return ~th.isclose(th.cat(gradients), expected, rtol=1e-3)
