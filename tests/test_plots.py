"""The pictures of analysis."""

import pytest
import torch as th

from sb3_cchain.analysis.plots import plot_models

DIAGONAL = th.diag(th.tensor([4.0, 3.0, 2.0, 1.0]))


def panels(ntks, names=("a",)):
    """The axes of the upper half, without those of colours."""
    figure = plot_models(names, ntks, ["pi", "vf"], {"weight norm": [[1.0, 2.0]] * len(names)})
    return [axes for axes in figure.axes[:-1] if axes.get_label() != "<colorbar>"]


@pytest.mark.parametrize("names", [("a",), ("a", "b")])
def test_beside_a_single_ntk_are_its_singular_values(names):
    _, axes = panels([(DIAGONAL, "NTK")], names)
    curve = axes.get_lines()[0]
    assert curve.get_xdata().tolist() == [1, 2, 3, 4]
    assert curve.get_ydata() == pytest.approx([0.4, 0.7, 0.9, 1.0])


def test_two_ntks_stand_side_by_side():
    assert [axes.get_title() for axes in panels([(DIAGONAL, "A"), (DIAGONAL, "B")], ("a", "b"))] == ["A", "B"]


def test_an_ntk_without_singular_values():
    _, zeros = panels([(th.zeros(2, 2), "NTK")])
    assert zeros.get_lines()[0].get_ydata().tolist() == [0, 0]
    _, axes = panels([(th.full((2, 2), th.nan), "NTK")])
    assert not axes.axison and "not finite" in axes.texts[0].get_text()
