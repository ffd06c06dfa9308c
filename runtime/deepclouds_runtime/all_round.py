"""Multiple scattering as surfaces see it: J at a place in every direction, for the light that the cloud throws on them.

A surface sees each point of the cloud from another direction than the camera does. J is smooth in that direction too: the phase function
has damped what varies fast, by g^l in the order l of spherical harmonics. So J is predicted at the nodes of a coarse octree in a few
directions spread over the sphere, and kept as spherical harmonics up to order 2, fitted by least squares.

What that leaves out is the part of a strong forward peak that light scattered twice still has: less than the light that is thrown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import vectors_of
from deepclouds_runtime.correction import FLOOR
from deepclouds_runtime.frame_source import Arriving, Seen, frame_source, part_of_time
from deepclouds_runtime.light_walks import LightWalks
from deepclouds_runtime.lights import Shade, on_host
from deepclouds_runtime.scattering import NetworkScattering
from deepclouds_runtime.transport import Cloud
from deepclouds_runtime.walked_source import walked_source

Array = NDArray[Any]
DIRECTIONS = 16
# Walks in the place of a query of the budget.
_WALKS_A_QUERY = 16
_HARMONICS = 9


class Direction:
    """Sees every point in one direction."""

    def __init__(self, w: Array) -> None:
        self._w = w

    def toward(self, points: Array) -> Array:
        """Unit vectors (n, 3) in which world points (n, 3) are seen."""
        return np.broadcast_to(self._w, points.shape)


class AllRound:
    """J at points of the cloud in any direction; see the module.

    Parameters
    ----------
    cloud
        the medium; its `scattering` is the network.
    lights
        where light comes from.
    seen, along
        points of the cloud that surfaces see, and the directions (n, 3) in which they see them.
    counts
        (n,) how much the light from there counts in the image.
    root, tolerance, budget, until, shade
        see `frame_source`.
    walks
        estimate J of more light, at nodes of their own; None for no more.
    seed
        of their random numbers.

    Attributes
    ----------
    sources
        harmonics of J at the nodes; none where it is 0 everywhere.
    queries
        asked of the network.
    factor
        of each colour channel, by which J is multiplied; 1 until walks say better.
    seen, along, counts
        as given.
    again
        J under further lights, which is added.
    """

    def __init__(
        self,
        cloud: Cloud,
        lights: Sequence[Arriving],
        seen: Seen,
        along: Array,
        counts: Array,
        root: float,
        tolerance: float,
        budget: int,
        walks: LightWalks | None = None,
        seed: int = 0,
        until: float = math.inf,
        shade: Shade | None = None,
    ) -> None:
        eyes = [Direction(w) for w in spread(DIRECTIONS)]
        walked = walks is not None and isinstance(cloud.scattering, NetworkScattering)
        first = part_of_time(until, 0.5) if walked else until
        found = [frame_source(cloud, lights, eyes, seen, root, tolerance, budget, fit, _HARMONICS, first, shade=shade)]
        if walks is not None and isinstance(cloud.scattering, NetworkScattering):
            most = min(_WALKS_A_QUERY * budget, walks.most)
            how = most, seed, fit, _HARMONICS, until
            found.append(walked_source(cloud, cloud.scattering, walks, eyes, seen, root, tolerance, *how, shade=shade))
        self.sources = [source for source in found if source is not None]
        self._channels, self._types = len(cloud.albedo), cloud.field.types
        self.queries = sum(source.queries for source in self.sources)
        self.seen, self.along, self.counts = seen, along, counts
        self.again: AllRound | None = None
        self.factor = np.ones(self._channels)

    def __call__(self, points: Any, w: Any) -> list[Any]:
        """J of every colour channel at points (Array3f) seen along unit vectors `w`."""
        total = self._own(points, w)
        if self.again is not None:
            total = [a + b for a, b in zip(total, self.again(points, w), strict=True)]
        return [value * dr.opaque(self._types.Float, float(f)) for value, f in zip(total, self.factor, strict=True)]

    def _own(self, points: Any, w: Any) -> list[Any]:
        total = [dr.zeros(self._types.Float, dr.width(points)) for _ in range(self._channels)]
        basis = harmonics(w.x, w.y, w.z)
        for source in self.sources:
            octree = source.octree
            values = octree.lookup(octree.to_local(points), self._types.Bool(True))
            sums = []
            for f in range(len(values) // _HARMONICS):
                terms = [b * v for b, v in zip(basis, values[f * _HARMONICS : (f + 1) * _HARMONICS], strict=True)]
                sums.append(dr.maximum(sum(terms[1:], terms[0]), 0))
            total = [a + b for a, b in zip(total, source.colours(sums), strict=True)]
        return total

    def correct(self, walks: LightWalks, count: int, seed: int) -> dict[str, Any]:
        """Set `factor` by `count` walks from points that surfaces see; returns it and its standard deviation, for a report.

        The factor is the ratio of the means of what walks find and of what is predicted, drawn toward 1 as far as chance explains it.
        """
        points, along, weights = self.seen.points, self.along, self.seen.weights * self.counts
        if not self.sources or not weights.sum() > 0:
            return {}
        x, w = vectors_of(self._types, points), vectors_of(self._types, along)
        predicted = on_host(self(x, w), len(points))
        level = predicted.mean(axis=1)
        wanted = weights * (level + max(FLOOR * float(np.average(level, weights=weights)), 1e-30))
        total = np.cumsum(wanted)
        random = np.random.default_rng([seed & 0xFFFFFFFF, 0x7420])
        place = (np.arange(count) + random.random()) / count * total[-1]
        drawn = np.minimum(np.searchsorted(total, place), len(total) - 1)
        found = walks(points[drawn], along[drawn], random)
        each = (weights[drawn] * (total[-1] / wanted[drawn]))[:, None]
        below = np.maximum((each * predicted[drawn]).mean(axis=0), 1e-30)
        residual = each * (found - predicted[drawn]) / below
        mean, variance = residual.mean(axis=0), residual.var(axis=0) / count
        self.factor = self.factor * np.maximum(1 + mean * np.maximum(1 - variance / np.maximum(np.square(mean), 1e-30), 0), 0)
        return {"factor": [round(float(f), 5) for f in self.factor], "deviation": [round(float(v), 5) for v in np.sqrt(variance)]}


def spread(count: int) -> Array:
    """Unit vectors (count, 3) spread evenly over the sphere: a spherical Fibonacci lattice (Keinert et al. 2015)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    azimuth = math.pi * (1 + math.sqrt(5)) * k
    sine = np.sqrt(1 - z * z)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), z], axis=1)


def harmonics(x: Any, y: Any, z: Any) -> list[Any]:
    """Real spherical harmonics up to order 2 of unit vectors, without their constant factors, which the fit takes in."""
    return [0 * x + 1, x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1]


def fit(values: Array) -> Array:
    """Coefficients (n, fields * 9) of values (directions, n, fields) in the directions of `spread`."""
    count, n, fields = values.shape
    basis = np.stack(harmonics(*spread(count).T), axis=1)
    result: Array = np.einsum("hd,dnf->nfh", np.linalg.pinv(basis), values).reshape(n, fields * _HARMONICS).astype(np.float32)
    return result
