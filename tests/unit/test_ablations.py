"""The variants of the ablations: what each is said to do, and the furnace identity's samples."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from deepclouds_training.features import FEATURES
from deepclouds_training.network import Network, NetworkConfig
from deepclouds_training.samples import Samples
from deepclouds_training.shards import Shard

from benchmarks.ablation_furnace import SUN_SETS, SUNS, furnace_loss, furnace_of
from benchmarks.ablation_networks import PHASE_COLUMNS, TAU_COLUMNS, Blind, DiffusionRatio, Shared
from benchmarks.ablation_page import body
from benchmarks.ablation_results import multiply_adds, weights
from benchmarks.ablation_training import BATCH, Learner, Plan, Readings, hidden, recipe_of
from benchmarks.ablation_variants import BASE, SETS, Variant
from deepclouds.backend import backend
from deepclouds.medium.field import Field
from deepclouds.model import LEVELS, POINTS, aux_inputs
from deepclouds.volume import Volume

VARIANTS = tuple(dict.fromkeys(v for variants in SETS.values() for v in variants))
CONFIG = NetworkConfig(width=16, compression="root")


def samples(count: int, seed: int = 5) -> Samples:
    rng = np.random.default_rng(seed)
    aux = aux_inputs(rng.uniform(0, np.pi, count), rng.uniform(-0.5, 0.9, count), 0.0, 1.0, rng.random(count), rng.exponential(2, count))
    stencil = rng.random((count, LEVELS, POINTS), dtype=np.float32)
    label = rng.random(count).astype(np.float32)
    return Samples(stencil, aux, label, 0.1 * label, np.stack([label, label], axis=1), np.zeros(count, np.int64))


def made(network: Network) -> Network:
    part = samples(64)
    network.fit_inputs(part.stencil, part.label)
    return network


@pytest.mark.parametrize(
    "variant", [v for v in VARIANTS if v.name not in ("power 0", "power 1", "power 2", "mixture")], ids=lambda v: v.name
)
def test_shared_readings_and_raw_inputs_are_the_same_function(variant: Variant) -> None:
    torch.manual_seed(1)
    network, part = variant.build(), samples(64)
    readings = Readings.fitted(part, [recipe_of(network.config)])
    network.fit_inputs(part.stencil, part.label)
    with torch.no_grad():
        got = network.leave(hidden(network, readings.of(part.stencil, part.aux, torch.float32)))
        expected = network(torch.from_numpy(part.stencil), torch.from_numpy(part.aux))
        exported = network.folded()(torch.from_numpy(part.stencil), torch.from_numpy(part.aux))
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=0)
    torch.testing.assert_close(exported, expected, rtol=1e-4, atol=0)


@pytest.mark.parametrize("columns", [TAU_COLUMNS, PHASE_COLUMNS])
def test_blind_networks_do_not_see_their_columns(columns: tuple[int, ...]) -> None:
    torch.manual_seed(1)
    net, part = made(Blind(CONFIG, columns)), samples(16)
    f = net.angle(torch.from_numpy(part.aux))
    levels = torch.unbind(torch.from_numpy(part.stencil), dim=1)
    with torch.no_grad():
        before = net.through(lambda k: levels[k], f, True)
        for column in range(FEATURES):
            changed = f.clone()
            changed[:, column] += 1
            same = torch.equal(net.through(lambda k: levels[k], changed, True), before)
            assert same == (column in columns), f"column {column}"
        # The optical depth enters by the last column of aux alone, and by no other feature.
        if columns == TAU_COLUMNS:
            stencil, aux = torch.from_numpy(part.stencil), torch.from_numpy(part.aux)
            deeper = aux.clone()
            deeper[:, 5] *= 2
            assert torch.equal(net(stencil, aux), net(stencil, deeper))


def test_a_shared_block_has_one_matrix_for_all_levels() -> None:
    assert weights(Shared(CONFIG)) < 0.2 * weights(Network(CONFIG))
    assert multiply_adds(Shared(CONFIG)) == pytest.approx(multiply_adds(Network(CONFIG)), rel=0.05)


def test_a_ratio_to_diffusion_multiplies_it() -> None:
    part = samples(32)
    net = made(DiffusionRatio(CONFIG))
    with torch.no_grad():
        net.head.weight.zero_()
        net.head.bias.fill_(np.log(3.0))
        got = net(torch.from_numpy(part.stencil), torch.from_numpy(part.aux)).numpy()
    _, g, _, _, albedo, log1p_tau = part.aux.T.astype(np.float64)
    t = np.expm1(log1p_tau) * (1 - g)
    expected = np.exp(-np.minimum(8, np.sqrt(3 * (1 - albedo) / (1 - albedo * g)) * t)) / (1 + 0.75 * t)
    np.testing.assert_allclose(got, 3 * expected, rtol=1e-3)


def test_small_variants_have_at_most_60000_weights() -> None:
    small = [v for v in VARIANTS if v.group == "small networks"]
    assert len(small) > 3
    assert all(weights(v.build()) <= 60_000 for v in small)


def thin_shard(depth: float) -> tuple[Shard, Field]:
    n = 64
    rng = np.random.default_rng(2)
    volume = Volume(np.ones((8, 8, 8), np.float32), np.eye(4))
    w = rng.normal(size=(n, 3))
    shard = Shard(
        volume=volume,
        scale=depth,
        point=rng.uniform(0.2, 0.8, (n, 3)).astype(np.float32),
        w=(w / np.linalg.norm(w, axis=1, keepdims=True)).astype(np.float32),
        phase=np.stack([rng.uniform(0.5, 0.9, n), np.full(n, -0.3), np.full(n, 0.8)], axis=1).astype(np.float32),
        kind=np.zeros(n, np.uint8),
        omega_sun=np.zeros((n, 1, 3), np.float32),
        tau_sun=np.zeros((n, 1), np.float32),
        albedo=np.ones((n, 1), np.float32),
        half=np.zeros((n, 1, 1, 2), np.float32),
        error=np.zeros((n, 1, 1), np.float32),
        walks=np.zeros(n, np.int32),
    )
    return shard, Field(backend(), volume, depth)


def test_single_scattering_alone_fulfils_the_furnace_identity_in_a_thin_medium() -> None:
    """Rationale: with no extinction J is 0 and S1 integrates to 1 over all suns, whatever the phase function.

    Expected behaviour: the mean over all suns is 1 within its noise, and the loss, a product of independent residuals, is 0 within its own.
    """
    furnace = furnace_of(*thin_shard(1e-4), 512, np.random.default_rng(1), 1.0)
    terms = (furnace.single * furnace.weight).astype(np.float64)
    assert abs(terms.mean() - 1) < 4 * terms.std() / np.sqrt(len(terms))
    assert np.all(furnace.aux[:, 4] == 1)
    single, weight = torch.from_numpy(furnace.single), torch.from_numpy(furnace.weight)
    zero = float(furnace_loss(torch.zeros_like(single), single, weight))
    one = float(furnace_loss(torch.ones_like(single), single, weight))
    noise = float(np.var(terms) / SUNS / np.sqrt(512))
    assert abs(zero) < 5 * noise
    # J / E = 1 / (4 pi) everywhere is one too much, and one squared is one.
    assert one == pytest.approx(1.0, abs=0.2)
    assert len(furnace.single) == 512 * SUN_SETS * SUNS


def test_a_restored_learner_goes_the_same_way(tmp_path: Path) -> None:
    part = samples(2 * BATCH)
    readings = Readings.fitted(part, [("depth", "root")])
    inputs, label = readings.of(part.stencil, part.aux, torch.bfloat16), torch.from_numpy(part.label)
    plan = Plan(tmp_path, 1.0)
    variant = next(v for v in VARIANTS if v.name == "pooled 16")
    threads = torch.get_num_threads()
    learners = [Learner(variant, seed, plan) for seed in (0, 1)]
    for learner in learners:
        learner.fit(part, readings)
    learners[0].learn(inputs.rows(0, BATCH), label[:BATCH], [1e-3], None)
    file = io.BytesIO()
    torch.save(learners[0].state(), file)
    file.seek(0)
    learners[1].restore(torch.load(file))
    for learner in learners:
        learner.learn(inputs.rows(BATCH, BATCH), label[BATCH:], [1e-3], None)
    torch.set_num_threads(threads)
    first, second = (learner.average.averaged(learner.network).state_dict() for learner in learners)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_the_table_compares_with_the_base() -> None:
    keys = ("halves rRMSE", "converged rRMSE", "median", "95 %", "halves energy", "converged energy")
    common = {"group": "g", "what": "w", "weights": 1, "multiply_adds": 1, "seconds": 1e-6, "batch": 256, "training_seconds": 1.0}
    rows = [
        {**common, "name": n, "seeds": [dict.fromkeys(keys, v), dict.fromkeys(keys, 1.02 * v)]} for n, v in ((BASE, 0.2), ("other", 0.1))
    ]
    large = {"weights": 1, "multiply_adds": 1, "seconds": 1e-6}
    text = body({"commit": "c", "samples": 10, "minutes": 1.0, "base": BASE, "large": large, "rows": rows})
    assert "| other: w | 1 | 1 | 1.00 | 10.10 +- 0.10 |" in text
    assert "| -50.0 +- 0.5 |" in text
