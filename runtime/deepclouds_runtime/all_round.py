"""Multiple scattering as surfaces see it: J at a place in every direction, for the light that the cloud throws on them.

A surface sees each point of the cloud from another direction than the camera does. J is smooth in that direction too: the phase function
has damped what varies fast, by g^l in the order l of spherical harmonics. So J is predicted at the nodes of a coarse octree in a few
directions spread over the sphere, and kept as spherical harmonics up to order 2, fitted by least squares.

What that leaves out is the part of a strong forward peak that light scattered a few times still has. Where there is one, these orders of
the light that is thrown are sampled (`Frame`), and harmonics tell what comes after them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds_runtime.frame_source import Arriving, Seen, frame_source
from deepclouds_runtime.lights import Shade
from deepclouds_runtime.transport import Cloud

Array = NDArray[Any]
DIRECTIONS = 16
# Of spherical harmonics.
ORDER = 2
_HARMONICS = (ORDER + 1) ** 2


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
    seen
        points of the cloud that surfaces see.
    root, tolerance, budget, until, shade
        see `frame_source`.

    Attributes
    ----------
    source
        harmonics of J at the nodes; None where it is 0 everywhere.
    queries
        asked of the network.
    seen
        as given.
    again
        J under further lights, which is added.
    """

    def __init__(
        self,
        cloud: Cloud,
        lights: Sequence[Arriving],
        seen: Seen,
        root: float,
        tolerance: float,
        budget: int,
        until: float = math.inf,
        shade: Shade | None = None,
    ) -> None:
        eyes = [Direction(w) for w in spread(DIRECTIONS)]
        self.source = frame_source(cloud, lights, eyes, seen, root, tolerance, budget, fit, _HARMONICS, until, shade=shade)
        self._channels, self._types = len(cloud.albedo), cloud.field.types
        self.queries = 0 if self.source is None else self.source.queries
        self.seen = seen
        self.again: AllRound | None = None

    def __call__(self, points: Any, w: Any) -> list[Any]:
        """J of every colour channel at points (Array3f) seen along unit vectors `w`."""
        total = self._own(points, w)
        if self.again is not None:
            total = [a + b for a, b in zip(total, self.again(points, w), strict=True)]
        return total

    def _own(self, points: Any, w: Any) -> list[Any]:
        if self.source is None:
            return [dr.zeros(self._types.Float, dr.width(points)) for _ in range(self._channels)]
        octree, basis = self.source.octree, harmonics(w.x, w.y, w.z)
        values = octree.lookup(octree.to_local(points), self._types.Bool(True))
        sums = []
        for f in range(len(values) // _HARMONICS):
            terms = [b * v for b, v in zip(basis, values[f * _HARMONICS : (f + 1) * _HARMONICS], strict=True)]
            sums.append(dr.maximum(sum(terms[1:], terms[0]), 0))
        return self.source.colours(sums)


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
