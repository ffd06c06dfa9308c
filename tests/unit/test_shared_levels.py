"""Rationale: points that lie close together see the same coarse surroundings, so that what a network makes of the coarse levels of a
stencil can be shared.

Expected behaviour: both halves of a network make the whole one; a network that reads its levels in another way is not cut; levels that are
not read are known; what corners know is interpolated between them, exactly where it varies linearly.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from deepclouds_runtime.corners import Corners
from deepclouds_runtime.octree import Lattice
from deepclouds_runtime.predictor import BATCH, Predictor
from deepclouds_runtime.scattering import Coarse
from deepclouds_runtime.shared_levels import cut, shared_levels
from numpy.typing import NDArray

from deepclouds.model import AUX, LEVELS, POINTS, aux_inputs
from deepclouds.model.trust import level_means

Array = NDArray[np.float32]


@pytest.fixture(scope="module")
def queries() -> tuple[Array, Array]:
    random = np.random.default_rng(7)
    n = BATCH + 100
    stencil = random.gamma(0.5, 1.0, (n, LEVELS, POINTS)).astype(np.float32)
    return stencil, aux_inputs(random.uniform(0, np.pi, n), 0.85, -0.3, 0.8, 0.99, random.gamma(1.0, 4.0, n))


@pytest.mark.parametrize("shared", [1, 5, 7, 9])
def test_two_halves_make_a_whole(queries: tuple[Array, Array], shared: int) -> None:
    stencil, aux = queries
    predictor = Predictor("accurate")
    whole, halves = predictor.predict(stencil, aux), predictor.halves(shared)
    assert halves is not None
    assert predictor.halves(shared) is halves
    j, latent = halves.begin(stencil, aux)
    np.testing.assert_allclose(j, whole, rtol=1e-5)
    # The second half never sees the coarse levels.
    np.testing.assert_allclose(halves.finish(latent, stencil[:, : LEVELS - shared], aux), whole, rtol=1e-4)
    other = stencil.copy()
    other[:, LEVELS - shared :] *= 2
    assert np.abs(halves.begin(other, aux)[1] - latent).max() > 0.01
    # The first half never sees the fine ones.
    other = stencil.copy()
    other[:, : LEVELS - shared] *= 2
    np.testing.assert_allclose(halves.begin(other, aux)[1], latent, rtol=1e-5, atol=1e-6)


def test_what_cannot_be_cut_is_not(queries: tuple[Array, Array]) -> None:
    stencil, aux = queries
    accurate, fast = Predictor("accurate"), Predictor("fast")
    assert accurate.halves(0) is None
    assert accurate.halves(LEVELS) is None
    assert fast.halves(7) is None
    assert accurate.read == list(range(LEVELS))
    # It reads every second level: the others may hold anything.
    assert fast.read == [0, 2, 4, 6, 8]
    other = stencil.copy()
    other[:, 1::2] = 0
    assert np.array_equal(fast.predict(other, aux), fast.predict(stencil, aux))


def test_a_network_that_looks_at_all_levels_at_once_is_not_cut(tmp_path: Path) -> None:
    from onnx import TensorProto, helper, numpy_helper

    inputs = [helper.make_tensor_value_info("stencil", TensorProto.FLOAT, ["n", LEVELS, POINTS])]
    inputs.append(helper.make_tensor_value_info("aux", TensorProto.FLOAT, ["n", len(AUX)]))
    output = [helper.make_tensor_value_info("j", TensorProto.FLOAT, ["n"])]
    axes = numpy_helper.from_array(np.array([1, 2], np.int64), "axes")
    node = helper.make_node("ReduceSum", ["stencil", "axes"], ["j"], keepdims=0)
    model = helper.make_model(helper.make_graph([node], "sum", inputs, output, [axes]))
    assert [cut(model, shared) for shared in range(LEVELS + 1)] == [None] * (LEVELS + 1)


def test_cells_share_the_fewer_levels_the_larger_they_are() -> None:
    found = [shared_levels(spacing) for spacing in (0.5, 2.0, 2.1, 4.0, 8.0, 8.1, 100.0)]
    assert found == sorted(found, reverse=True)
    assert found[1] > found[2] > found[4] > found[5] == 0


def test_errors_to_expect_need_no_more_than_means_of_coarse_levels(queries: tuple[Array, Array]) -> None:
    stencil, aux = queries
    predictor = Predictor("accurate")
    j = predictor.predict(stencil, aux)
    some, all_of_them = predictor.errors(stencil[:, :3], aux, j, level_means(stencil[:, 3:])), predictor.errors(stencil, aux, j)
    assert some is not None
    assert all_of_them is not None
    np.testing.assert_allclose(some, all_of_them, rtol=1e-6)


class TestCorners:
    """A lattice of four cells in a row, of which the corners of the first three are known."""

    lattice = Lattice(np.array([-1.0, 0.5, 2.0]), np.eye(3), 0.5, np.array([4, 1, 1]))
    corners = np.array([[x, y, z] for z in range(2) for y in range(2) for x in range(4)], float)

    def known(self, points: NDArray[np.float64]) -> Coarse:
        """A linear function of the place."""
        x = points.astype(np.float32)
        latent = np.stack([1 + 2 * x[:, 0] - x[:, 1], x[:, 2]], axis=1)
        return Coarse(latent[:, None, :], x[:, None, :2], x[:, 1] + 0.5 * x[:, 0])

    def test_linear_functions_are_exact(self) -> None:
        corners, world = Corners(self.lattice, 2), self.lattice.world(self.corners)
        assert corners.among(world).all()
        assert not corners.around(world)[0].any()
        one = self.known(world)
        corners.keep(world, [one, Coarse(2 * one.latent, 2 * one.means, 2 * one.depth)])
        # Only the coarsest corners, which come first, are kept.
        assert not corners.among(world).any()
        local = np.array([[0.2, 0.3, 0.9], [2.9, 0.0, 1.0], [1.0, 1.0, 0.0], [3.0, 0.5, 0.5], [3.1, 0.5, 0.5], [0.0, 0.0, 0.0]])
        points = self.lattice.world(local)
        told, index, weights = corners.around(points)
        # On the face between a known cell and another one corners of the face are enough.
        assert told.tolist() == [True, True, True, True, False, True]
        for pair, factor in ((0, 1), (1, 2)):
            found, wanted = corners.between(pair, index[told], weights[told]), self.known(points[told])
            for name in ("latent", "means", "depth"):
                np.testing.assert_allclose(getattr(found, name), factor * getattr(wanted, name), rtol=1e-5, atol=1e-5)

    def test_points_beside_the_corners_are_none_of_them(self) -> None:
        corners, world = Corners(self.lattice, 1), self.lattice.world(self.corners)
        moved = world + np.array([0.1, 0, 0])
        assert not corners.among(moved).any()
        assert not corners.around(moved)[0].any()

    def test_too_much_is_not_kept(self, monkeypatch: pytest.MonkeyPatch) -> None:
        world = self.lattice.world(self.corners)
        monkeypatch.setattr("deepclouds_runtime.corners._MOST_BYTES", 100)
        corners = Corners(self.lattice, 1)
        corners.keep(world, [self.known(world)])
        assert not corners.around(world)[0].any()
