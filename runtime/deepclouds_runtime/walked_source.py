"""Multiple scattering of light from all around, by walks at the nodes of an octree.

A walk sees such light where it leaves the cloud, and nearly every walk sees some. A network is asked once for each of many directions: a
hundred walks from a node cost less, and know J to a few percent, without bias.
"""

from __future__ import annotations

import math

import numpy as np

from deepclouds_runtime.frame_source import FrameSource, Seen, Sees, interpolated
from deepclouds_runtime.light_walks import LightWalks
from deepclouds_runtime.lights import Shade
from deepclouds_runtime.octree import Array, Lattice
from deepclouds_runtime.scattering import NetworkScattering, Stopped
from deepclouds_runtime.transport import Cloud

# Noise of a node's J that its walks are for, over the mean, and the fewest and the most of them.
_NOISE, _FEWEST, _MOST = 0.06, 64, 512
# A trial that tells how many: points, and walks from each.
_TRIED, _TRIALS = 64, 64
# Points at which the interpolation is measured.
_CHECKS = 256
# Walks that are in memory together.
_AT_ONCE = 1 << 18


def walked_source(
    cloud: Cloud,
    network: NetworkScattering,
    walks: LightWalks,
    eye: Sees,
    seen: Seen,
    root: float,
    tolerance: float,
    most: int,
    seed: int,
    until: float = math.inf,
    finest: float = 0.0,
    shade: Shade | None = None,
) -> FrameSource | None:
    """J of a frame under the lights of `walks`; None where the camera sees no cloud, or it is black.

    Parameters
    ----------
    cloud, seen, root, tolerance, until, finest, shade
        see `deepclouds_runtime.frame_source.frame_source`.
    network
        has the unit of length, and knows whether to give up, by `Stopped`; it is not asked.
    walks
        estimate J.
    eye
        tells in which direction each point is seen.
    most
        walks at nodes.
    seed
        of all random numbers.
    """
    if not any(cloud.albedo) or not len(seen.points) or network.descriptor.empty:
        return None
    found = _Walked(walks, eye, len(cloud.albedo), network, seed)
    found.choose(seen)
    how = cloud.field, network, found, seen, root, tolerance, most // found.each, _CHECKS, walks.lights
    return interpolated(*how, until=until, overdrawn=1, finest=finest, shade=shade)


class _Walked:
    """What the octree interpolates: J of each colour channel, means of walks."""

    def __init__(self, walks: LightWalks, eye: Sees, channels: int, network: NetworkScattering, seed: int) -> None:
        self._walks, self._eye, self._network = walks, eye, network
        self._random = np.random.default_rng([seed & 0xFFFFFFFF, 0x3C1D])
        self.mix: Array = np.eye(channels)
        self.carried = 2 if network.knows_errors else 0
        self.queries, self.shared, self.spared, self.model, self.each = 0, 0, 0, "", _TRIALS

    def choose(self, seen: Seen) -> None:
        """Set how many walks start at a node, from a trial at what the camera sees."""
        total = np.cumsum(seen.weights)
        points = seen.points[np.searchsorted(total, (np.arange(_TRIED) + 0.5) / _TRIED * total[-1])]
        mean, variance = self._estimated(points)
        level = float(mean.mean())
        if level > 0:
            needed = float(variance.mean()) * _TRIALS / (_NOISE * level) ** 2
            self.each = int(np.clip(2 ** np.ceil(np.log2(max(needed, 1.0))), _FEWEST, _MOST))

    def on_lattice(self, lattice: Lattice, levels: int) -> None:
        """Nothing is shared between points."""

    def __call__(self, points: Array) -> Array:
        """Fields (n, l) at world points (n, 3); the last `carried` of them are the sum of the others and its standard deviation."""
        mean, variance = self._estimated(points)
        fields = mean.astype(np.float32)
        if not self.carried:
            return fields
        # Channels of one walk err together.
        error = np.sqrt(variance).sum(axis=1)
        return np.concatenate([fields, fields.sum(axis=1, keepdims=True), error[:, None].astype(np.float32)], axis=1)

    def _estimated(self, points: Array) -> tuple[Array, Array]:
        """Means of J (n, channels) as the eye sees it, and their variances."""
        n, each, channels = len(points), self.each, len(self.mix)
        mean, variance = np.zeros((n, channels)), np.zeros((n, channels))
        for start in range(0, n, max(1, _AT_ONCE // each)):
            if self._network.stop is not None and self._network.stop():
                raise Stopped
            part = points[start : start + max(1, _AT_ONCE // each)]
            j = self._walks(np.repeat(part, each, axis=0), np.repeat(self._eye.toward(part), each, axis=0), self._random)
            j = j.reshape(len(part), each, channels)
            mean[start : start + len(part)] = j.mean(axis=1)
            variance[start : start + len(part)] = j.var(axis=1) / (each - 1)
        return mean, variance
