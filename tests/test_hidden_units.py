"""Which weights lead out of which unit."""

import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor, NatureCNN
from torch import nn
from torch.nn import functional as F

from sb3_cchain.analysis.metrics.dormancy import mean_activity
from sb3_cchain.methods.hidden_units import find_hidden_units, hidden_activity
from sb3_cchain.networks import CReLU, FourierFeatures
from sb3_cchain.networks.extractors import ImpalaCNN, MinAtarCNN


def find(network, *shape):
    network.eval()
    return {layer.layer: layer for layer in find_hidden_units(network, lambda: network(th.zeros(1, *shape)))}


def reaches(network, layer, unit, inputs):
    """By another way: which inputs of the next layers move when the unit's activation does."""
    received = {}
    modules = {name: network.get_submodule(name) for name in layer.outgoing}

    def forward(bump):
        def push(module, inputs, output):
            output = output.clone()
            output[:, unit] += bump
            return output

        hooks = [network.get_submodule(layer.layer).register_forward_hook(push)]
        for name, module in modules.items():
            hooks.append(module.register_forward_pre_hook(lambda m, x, name=name: received.__setitem__((name, bump), x[0])))
        with th.no_grad():
            network(inputs)
        for hook in hooks:
            hook.remove()

    forward(0.0)
    forward(1e6)
    moved = {}
    for name, module in modules.items():
        dims = [0] if isinstance(module, nn.Linear) else [0, 2, 3]
        moved[name] = (received[name, 0.0] != received[name, 1e6]).any(dim=0)
        if len(dims) > 1:
            moved[name] = moved[name].any(dim=2).any(dim=1)
    return moved


BOX = spaces.Box(0, 255, (12, 12, 3), "uint8")
FRAMES = spaces.Box(0, 255, (1, 36, 36), "uint8")


@pytest.mark.parametrize(
    "make, shape, hidden",
    [
        (lambda: MinAtarCNN(BOX, features_dim=5), (12, 12, 3), ["cnn.0", "linear.0"]),
        (lambda: NatureCNN(FRAMES, features_dim=5), (1, 36, 36), ["cnn.0", "cnn.2", "cnn.4", "linear.0"]),
        (
            lambda: ImpalaCNN(BOX, features_dim=5, channels=(2, 3)),
            (12, 12, 3),
            ["cnn.2.residual.1", "cnn.3.residual.1", "cnn.6.residual.1", "cnn.7.residual.1", "linear.1"],
        ),
    ],
)
def test_channels_are_followed_through_flattening(make, shape, hidden):
    network = nn.Sequential()
    network.extractor, network.head = make(), nn.Linear(5, 2)
    layers = find(network, *shape)
    assert list(layers) == [f"extractor.{name}" for name in hidden]
    inputs = th.rand(2, *shape) + 0.1
    for layer in layers.values():
        for unit in range(layer.n_units):
            for name, moved in reaches(network, layer, unit, inputs).items():
                assert th.equal(layer.outgoing[name] == unit, moved), (layer.layer, unit, name)


def test_flattened_channels_differ_in_order():
    last = find(nn.Sequential(MinAtarCNN(BOX, features_dim=5), nn.Linear(5, 2)), 12, 12, 3)["0.cnn.0"]
    assert last.outgoing["0.linear.0"].tolist() == list(range(16)) * 100
    first = find(nn.Sequential(NatureCNN(FRAMES, features_dim=5), nn.Linear(5, 2)), 1, 36, 36)["0.cnn.4"]
    assert first.outgoing["0.linear.0"].tolist() == list(range(64))
    flattened = nn.Sequential(nn.Conv2d(1, 3, 1), nn.Tanh(), nn.Flatten(), nn.Linear(12, 2))
    assert find(flattened, 1, 2, 2)["0"].outgoing["3"].tolist() == [0] * 4 + [1] * 4 + [2] * 4


def test_layer_norms_between():
    layers = find(nn.Sequential(MinAtarCNN(BOX, features_dim=5, layer_norm=True), nn.Linear(5, 2)), 12, 12, 3)
    assert layers["0.cnn.0"].norms["0.linear.0"].tolist() == list(range(16)) * 100
    assert layers["0.linear.2"].norms["0.linear.3"].tolist() == list(range(5))


@pytest.mark.parametrize("activation", [CReLU, FourierFeatures])
def test_activations_that_double_the_width(activation):
    layers = find(nn.Sequential(nn.Linear(2, 3), activation(), nn.Linear(6, 2)), 2)
    assert layers["0"].outgoing["2"].tolist() == [0, 1, 2, 0, 1, 2]


def test_dict_observations():
    space = spaces.Dict({"frame": FRAMES, "vector": spaces.Box(-2, 2, (3,)), "choice": spaces.Discrete(2)})
    network = nn.Sequential(CombinedExtractor(space, cnn_output_dim=4), nn.Linear(9, 2))
    zeros = {"frame": th.zeros(1, 1, 36, 36), "vector": th.zeros(1, 3), "choice": th.tensor([[1.0, 0.0]])}
    layers = find_hidden_units(network, lambda: network(zeros))
    by_name = {layer.layer: layer for layer in layers}
    # In the order of the keys: choice, frame, vector
    assert by_name["0.extractors.frame.linear.0"].outgoing["1"].tolist() == [-1, -1, 0, 1, 2, 3, -1, -1, -1]


class Functional(nn.Module):
    """Two branches that read the same layer, which activates by a function."""

    def __init__(self, scale=None):
        super().__init__()
        self.first, self.left, self.right, self.scale = nn.Linear(2, 3), nn.Linear(3, 1), nn.Linear(3, 1), scale

    def forward(self, inputs):
        hidden = F.relu(self.first(inputs))
        outputs = self.left(hidden) + self.right(hidden)
        return outputs if self.scale is None else self.right(hidden * self.scale)


def test_branches():
    assert list(find(Functional(), 2)["first"].outgoing) == ["left", "right"]


@pytest.mark.parametrize(
    "network",
    [
        Functional(scale=0.5),
        nn.Sequential(nn.Linear(2, 3), nn.BatchNorm1d(3), nn.ReLU(), nn.Linear(3, 2)),
        nn.Sequential(nn.Linear(2, 3), nn.Softmax(dim=1), nn.Linear(3, 2)),
        nn.Sequential(nn.Linear(2, 4)),
    ],
)
def test_what_is_not_known_is_left_alone(network):
    assert find(network, 2) == {}


class Residual(nn.Module):
    def __init__(self):
        super().__init__()
        self.first, self.inner, self.outer, self.last = (nn.Linear(3, 3) for _ in range(4))

    def forward(self, inputs):
        stream = self.first(inputs)
        return self.last(F.relu(stream + self.outer(F.relu(self.inner(F.relu(stream))))))


def test_residual_streams_are_left_alone():
    assert list(find(Residual(), 3)) == ["inner"]


def test_nothing_stays_hooked_or_changed():
    network = nn.Sequential(nn.Linear(2, 3), nn.ReLU(), nn.Linear(3, 2))
    inputs, parameters = th.rand(4, 2), [p.clone() for p in network.parameters()]
    outputs = network(inputs)
    find(network, 2)
    assert th.equal(network(inputs), outputs)
    assert all(th.equal(p, q) and p.grad is None for p, q in zip(network.parameters(), parameters, strict=True))


def test_activity_where_the_next_layers_receive_it():
    network = nn.Sequential(nn.Conv2d(1, 3, 3), nn.ReLU(), nn.Flatten(), nn.Linear(12, 4), CReLU(), nn.Linear(8, 2))
    inputs = th.randn(5, 1, 4, 4)
    layers = list(find(network, 1, 4, 4).values())
    convolution, linear = hidden_activity(network, layers, lambda: network(inputs))
    assert th.allclose(convolution, mean_activity(network[:2](inputs)))
    # Of both halves of CReLU
    assert th.allclose(linear, network[:4](inputs).abs().mean(dim=0) / 2)
    branches = Functional()
    (hidden,) = hidden_activity(branches, list(find(branches, 2).values()), lambda: branches(inputs[:, 0, 0, :2]))
    assert th.allclose(hidden, F.relu(branches.first(inputs[:, 0, 0, :2])).mean(dim=0))


def test_activations_that_write_into_what_they_are_given():
    network, in_place = (
        nn.Sequential(nn.Linear(3, 4), nn.ReLU(inplace), nn.Linear(4, 5), nn.LeakyReLU(inplace=inplace), nn.Linear(5, 1))
        for inplace in (False, True)
    )
    layers, same = find(network, 3), find(in_place, 3)
    assert list(layers) == list(same) == ["0", "2"]
    for name, layer in layers.items():
        assert all(th.equal(source, same[name].outgoing[reached]) for reached, source in layer.outgoing.items())
