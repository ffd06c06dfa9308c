"""The network's invariants: features, order of the levels, and finite output for every finite input."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
import torch
from deepclouds_training.features import FEATURES, ORDERS, AngleFeatures
from deepclouds_training.network import Network, NetworkConfig
from deepclouds_training.pooling import mirrored_points
from pydantic import ValidationError

from deepclouds.descriptor import offsets
from deepclouds.medium.phase import hg_numpy
from deepclouds.model import LEVELS, POINTS, aux_inputs

SMALL = NetworkConfig(width=16)


def network(config: NetworkConfig = SMALL) -> Network:
    torch.manual_seed(3)
    return Network(config)


def random_inputs(count: int, seed: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    aux = aux_inputs(rng.uniform(0, np.pi, count), rng.uniform(-0.9, 0.9, count), 0.0, 1.0, rng.random(count), rng.uniform(0, 20, count))
    return torch.from_numpy(rng.random((count, LEVELS, POINTS), dtype=np.float32)), torch.from_numpy(aux)


def orders(gamma: np.ndarray, g1: float, g2: float, weight: float) -> np.ndarray:
    aux = torch.from_numpy(aux_inputs(gamma, g1, g2, weight, 1.0, 0.0))
    return AngleFeatures().phase_of_orders(*torch.split(aux, 1, dim=1)[:4]).numpy()


@pytest.mark.parametrize("g", [-0.95, -0.3, 0.0, 0.5, 0.85, 0.99])
def test_one_lobe_is_exact_at_every_order(g: float) -> None:
    gamma = np.array([0.0, 1e-4, 1e-2, 0.3, 1.5, 3.0, np.pi], np.float32)
    for column, n in zip(orders(gamma, g, 0.0, 1.0).T, ORDERS, strict=True):
        # float32 g^n near 1 limits the peak itself; the tolerance covers 1 / (1 - g^n).
        expected = 4 * np.pi * hg_numpy(np.cos(gamma.astype(np.float64)), float(np.float32(g)) ** n)
        np.testing.assert_allclose(column, expected, rtol=2e-6 / (1 - abs(g)) + 1e-6)


def test_two_lobes_convolve_as_their_legendre_moments_multiply() -> None:
    g1, g2, weight = 0.8, -0.35, 0.7
    gamma = np.linspace(0, np.pi, 9)
    degree = np.arange(120)
    moments = weight * g1**degree + (1 - weight) * g2**degree
    for column, n in zip(orders(gamma, g1, g2, weight).T, ORDERS, strict=True):
        expected = np.polynomial.legendre.legval(np.cos(gamma), (2 * degree + 1) * moments**n)
        np.testing.assert_allclose(column, expected, rtol=1e-5)


def test_equal_lobes_are_one_lobe_whatever_the_weight() -> None:
    gamma = np.linspace(0, np.pi, 7)
    np.testing.assert_allclose(orders(gamma, 0.6, 0.6, 0.3), orders(gamma, 0.6, 0.0, 1.0), rtol=1e-5)


def test_features_are_of_order_one() -> None:
    _, aux = random_inputs(5000)
    features = AngleFeatures()(aux)
    assert features.shape == (5000, FEATURES)
    assert float(features.abs().max()) < 3
    # Every column tells rows apart, except g2 and the weight, which single lobes fix.
    assert int((features.std(dim=0) > 0.05).sum()) == FEATURES - 2


@pytest.mark.parametrize("compression", ["log", "root"])
@pytest.mark.parametrize("stencil", [0.0, 1e-30, 1.0, 1e5, 1e38])
def test_output_is_finite_and_positive_at_the_extremes(stencil: float, compression: Literal["log", "root"]) -> None:
    rows = [
        (gamma, g1, g2, weight, albedo, np.log1p(tau))
        for gamma in (0.0, np.pi)
        for g1, g2, weight in ((0.99, 0.0, 1.0), (-0.99, 0.0, 1.0), (1.0, -1.0, 0.5), (0.99, -0.99, 0.0))
        for albedo in (0.0, 1.0)
        for tau in (0.0, 1e6, 1e30)
    ]
    aux = torch.tensor(rows, dtype=torch.float32, requires_grad=True)
    net = network(NetworkConfig(width=16, compression=compression))
    j = net(torch.full((len(rows), LEVELS, POINTS), stencil), aux)
    assert torch.all(torch.isfinite(j))
    assert torch.all(j > 0)
    j.sum().backward()
    assert all(torch.all(torch.isfinite(p.grad)) for p in net.parameters() if p.grad is not None)


def test_rows_do_not_know_of_each_other() -> None:
    stencil, aux = random_inputs(40)
    net = network()
    order = torch.randperm(40, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(net(stencil, aux)[order], net(stencil[order], aux[order]), rtol=1e-5, atol=0)
    torch.testing.assert_close(net(stencil, aux)[:3], net(stencil[:3], aux[:3]), rtol=1e-5, atol=0)


@pytest.mark.parametrize(("order", "first"), [("coarse_first", LEVELS - 1), ("fine_first", 0)])
def test_first_block_reads_the_named_end_of_the_scales(order: Literal["coarse_first", "fine_first"], first: int) -> None:
    stencil, aux = random_inputs(8)
    net = network(NetworkConfig(width=16, order=order))
    block = net.blocks[0]
    with torch.no_grad():
        block.stencil.weight.zero_()  # type: ignore[operator, union-attr]
        before = net(stencil, aux)
        for level in range(LEVELS):
            changed = stencil.clone()
            changed[:, level] *= 3
            moved = not torch.equal(net(changed, aux), before)
            assert moved == (level != first), f"level {level}"


def test_later_blocks_read_what_earlier_ones_carried() -> None:
    stencil, aux = random_inputs(8)
    net = network()
    with torch.no_grad():
        # Without carried information and residuals only the finest level is left, so the coarse one is blind.
        changed = stencil.clone()
        changed[:, LEVELS - 1] *= 3
        assert not torch.equal(net(changed, aux), net(stencil, aux))
        inputs: list[torch.Tensor] = []
        handles = [b.register_forward_pre_hook(lambda _, args: inputs.append(args[4])) for b in net.blocks]
        net(stencil, aux)
        for handle in handles:
            handle.remove()
    assert inputs[0] is None
    assert all(o.shape == (8, 16) for o in inputs[1:])


@pytest.mark.parametrize(("scale", "factor"), [("depth", 2.0), ("density", 1.0)])
def test_levels_are_standardised_log1p_values(scale: Literal["depth", "density"], factor: float) -> None:
    stencil, _ = random_inputs(64)
    label = np.full(64, 0.37, np.float32)
    net = network(NetworkConfig(width=16, scale=scale))
    net.fit_inputs(stencil.numpy(), label)
    for k in (0, 4, 9):
        plain = np.log1p(stencil[:, k].numpy().astype(np.float64) * factor**k)
        expected = (plain - plain.mean()) / plain.std()
        got = (net.compressed(stencil[:, k], k) - net.level_mean[k]) * net.level_scale[k]
        np.testing.assert_allclose(got, expected, atol=2e-3)
    assert float(net.head.bias.detach()) == pytest.approx(np.log(0.37), rel=1e-5)


@pytest.mark.parametrize(
    "config", [SMALL, NetworkConfig(width=16, symmetric=True, head="octaves"), NetworkConfig(width=16, channels=4, compression="root")]
)
def test_folded_network_is_the_same_function(config: NetworkConfig) -> None:
    stencil, aux = random_inputs(64)
    net = network(config)
    net.fit_inputs(stencil.numpy(), np.ones(64, np.float32))
    torch.testing.assert_close(net.folded()(stencil, aux), net(stencil, aux), rtol=1e-5, atol=0)


def test_levels_without_a_block_are_not_read() -> None:
    stencil, aux = random_inputs(8)
    net = network(NetworkConfig(width=16, levels=(0, 3, 9)))
    assert len(net.blocks) == 3
    for k in range(LEVELS):
        changed = stencil.clone()
        changed[:, k] *= 3
        assert torch.equal(net(changed, aux), net(stencil, aux)) == (k not in (0, 3, 9)), f"level {k}"


@pytest.mark.parametrize("levels", [(), (0, 0, 1), (3, 1), (-1, 2), (0, LEVELS)])
def test_levels_that_do_not_ascend_or_exist_are_refused(levels: tuple[int, ...]) -> None:
    with pytest.raises(ValidationError, match="ascending"):
        NetworkConfig(levels=levels)


def test_mirroring_turns_x_round_and_nothing_else() -> None:
    assert np.array_equal(offsets()[mirrored_points()], offsets() * [-1, 1, 1])


@pytest.mark.parametrize(
    ("config", "symmetric"),
    [
        (NetworkConfig(width=16, symmetric=True), True),
        (NetworkConfig(width=16, channels=4, together=2), True),
        (NetworkConfig(width=16, channels=4, levels=(0, 4, 8)), True),
        (SMALL, False),
    ],
)
def test_symmetric_networks_give_the_same_for_the_mirror_image_and_others_do_not(config: NetworkConfig, symmetric: bool) -> None:
    stencil, aux = random_inputs(32)
    net = network(config)
    net.fit_inputs(stencil.numpy(), np.ones(32, np.float32))
    with torch.no_grad():
        turned = net(stencil[:, :, mirrored_points()], aux)
        assert torch.allclose(net(stencil, aux), turned, rtol=1e-5, atol=0) == symmetric
        # It is not blind either: another odd part makes another output.
        other = stencil.clone()
        other[:, :, offsets()[:, 0] < 0] += 1.0
        assert not torch.allclose(net(stencil, aux), net(other, aux), rtol=1e-4, atol=0)


def test_octaves_multiply_the_output() -> None:
    stencil, aux = random_inputs(200)
    net = network(NetworkConfig(width=16, head="octaves"))
    with torch.no_grad():
        net.head.weight.zero_()
        net.head.bias.fill_(np.log(3.0))
        got = net(stencil, aux).numpy()
    gamma, g, _, _, _, log1p_tau = aux.numpy().T.astype(np.float64)
    tau = np.expm1(log1p_tau)
    lobes = [4 * np.pi * hg_numpy(np.cos(gamma), h) for h in (g**2, g**4, g**8)]
    expected = 0.02 + sum(0.5**i * np.exp(-(0.5**i) * tau) * p for i, p in enumerate(lobes, 1))
    np.testing.assert_allclose(got, 3 * expected, rtol=1e-3)


def test_pooled_blocks_read_their_levels_and_no_others() -> None:
    stencil, aux = random_inputs(8)
    net = network(NetworkConfig(width=16, channels=4, together=2, levels=(0, 3, 5, 9)))
    assert len(net.blocks) == 2
    for k in range(LEVELS):
        changed = stencil.clone()
        changed[:, k] *= 3
        assert torch.equal(net(changed, aux), net(stencil, aux)) == (k not in (0, 3, 5, 9)), f"level {k}"


def test_pooling_makes_means() -> None:
    """A homogeneous level is what it was in every channel as long as the weights sum to 1, as they do at the start."""
    net = network(NetworkConfig(width=16, channels=5))
    assert net.pooling is not None
    pooled = net.pooling(torch.full((2, LEVELS, POINTS), 0.7))
    torch.testing.assert_close(pooled, torch.full((2, LEVELS, 5), 0.7))
    assert torch.all(net.pooling.weight() >= 0)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"symmetric": True, "channels": 4}, "symmetric already"),
        ({"together": 2}, "pooled levels alone"),
        ({"channels": 4, "together": 3}, "divide"),
    ],
)
def test_shapes_that_do_not_fit_together_are_refused(fields: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        NetworkConfig.model_validate(fields)
