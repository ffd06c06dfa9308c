"""The network's j, summed over the lights of a frame: what an octree interpolates.

Of a network that goes from coarse to fine the first part, which sees the coarse levels, is asked at the corners of the coarsest cells
alone; for the points in them, which see the same coarse surroundings, what it hands on is interpolated
(`deepclouds_runtime.shared_levels`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import lanes_of, vectors_of
from deepclouds.medium.optical_depth import optical_depth
from deepclouds_runtime.between_albedos import TOLD, BetweenAlbedos
from deepclouds_runtime.corners import Corners
from deepclouds_runtime.lights import on_host
from deepclouds_runtime.octree import Array, Lattice
from deepclouds_runtime.scattering import Albedos, Coarse, NetworkScattering, Phase
from deepclouds_runtime.shared_levels import shared_levels
from deepclouds_runtime.transport import Cloud

if TYPE_CHECKING:
    from deepclouds_runtime.frame_source import Arriving, Sees

# Queries that are prepared together.
_AT_ONCE = 16384
# An optical depth beyond which nothing arrives.
_DEEP = 1e6
# Places around a point that tell what an albedo is there on the mean, and how far away they lie, in units of length.
_AROUND, _REACH = 32, 2.0
# Views closer to the light's direction than this, by the sine of the angle, share nothing.
_ALONG = 0.1
# Nor do points whose log(1 + optical depth toward the light) differs by so much from that of the corners around them.
_UNEXPECTED = 0.2


class Predicted:
    """What the octree interpolates: the network's j summed over lights, one field for each different albedo or for each colour channel."""

    def __init__(
        self,
        cloud: Cloud,
        network: NetworkScattering,
        lights: Sequence[Arriving],
        albedos: tuple[float, ...],
        eyes: Sequence[Sees],
        combine: Callable[[Array], Array],
    ) -> None:
        self._cloud, self._network, self._lights, self._eyes, self._combine = cloud, network, lights, eyes, combine
        self.queries, self.shared, self.spared = 0, 0, 0
        self._between = BetweenAlbedos(albedos if cloud.varying is None else ())
        # How many coarse levels points in a cell share, and what is known of them at its corners.
        self._levels = 0
        self._corners: Corners | None = None
        path = getattr(network.predictor, "path", None)
        self.model = "" if path is None else path.stem
        # What one eye sees is looked at itself; of several, only mixtures are.
        self.carried = 2 if network.knows_errors and len(eyes) == 1 else 0
        square = np.array(cloud.albedo) ** 2 / (4 * math.pi)
        tint = _tint(lights) if cloud.varying is None else None
        self._brightest = -1
        # Which of the albedos each field belongs to.
        self._of_field = [albedos.index(a) if a > 0 else -1 for a in cloud.albedo]
        if cloud.varying is not None:
            # Its albedos are part of each field.
            self.mix, self._of_field = np.eye(len(cloud.albedo)) / (4 * math.pi), list(range(len(cloud.albedo)))
        elif tint is None:
            self.mix = np.diag(square)
        else:
            self._brightest = int(np.argmax(tint))
            self.mix = np.zeros((len(cloud.albedo), len(albedos)))
            for c, k in enumerate(self._of_field):
                if k >= 0:
                    self.mix[c, k] = square[c] * tint[c] / tint[self._brightest]
            self._of_field = list(range(len(albedos)))

    def on_lattice(self, lattice: Lattice, levels: int) -> None:
        """What is made of the coarse levels at the corners of its cells is shared by the points in them, if the cells are split."""
        if self._cloud.varying is not None:
            # Which albedos are equal, and so how many are asked for, depends on the points.
            return
        shared = shared_levels(lattice.spacing / self._network.descriptor.unit) if levels > 0 else 0
        if shared and self._network.shares(shared):
            self._levels, self._corners = shared, Corners(lattice, len(self._eyes) * len(self._lights))

    def __call__(self, points: Array) -> Array:
        """Fields (n, l) at world points (n, 3); the last `carried` of them are the sum of the others and the error to expect of it."""
        n = len(points)
        total = np.zeros((len(self._eyes), n, self.mix.shape[1]), np.float32)
        error = np.zeros(n, np.float32)
        if self._corners is None:
            self._sum(points, np.arange(n), total, error)
        else:
            first = self._corners.among(points)
            known, corners, weights = self._corners.around(points)
            if first.any():
                made = self._sum(points, np.flatnonzero(first), total, error, keep=True)
                self._corners.keep(points[first], made)
            self._sum(points, np.flatnonzero(~first & ~known), total, error)
            self._sum(points, np.flatnonzero(known), total, error, (corners, weights))
        combined = self._combine(total)
        return np.concatenate([combined, combined.sum(axis=1, keepdims=True), error[:, None]], axis=1) if self.carried else combined

    def _sum(
        self,
        points: Array,
        chosen: Array,
        total: Array,
        error: Array,
        around: tuple[NDArray[np.int64], Array] | None = None,
        keep: bool = False,
    ) -> list[Coarse]:
        """Add up J and errors of all lights at some of the points; what is to be kept of the coarse levels, for each eye and light.

        Where the corners `around` all of the points are known, and their weights, nothing is asked of the network again that these tell.
        """
        kept: list[Coarse] = []
        pairs = list(itertools.product(range(len(self._eyes)), range(len(self._lights))))
        at_once = max(1, _AT_ONCE // max(len(chosen), 1))
        for first in range(0, len(pairs), at_once) if len(chosen) else ():
            some = range(first, min(first + at_once, len(pairs)))
            coarse = None
            if around is not None and self._corners is not None:
                corners, weights = (v[chosen] for v in around)
                coarse = Coarse.joined([self._corners.between(pair, corners, weights) for pair in some])
            made = self._add(points[chosen], chosen, [pairs[pair] for pair in some], total, error, coarse, keep)
            if made is not None:
                kept += made.split(len(some))
        return kept

    def _add(
        self,
        points: Array,
        chosen: Array,
        pairs: Sequence[tuple[int, int]],
        total: Array,
        error: Array,
        coarse: Coarse | None,
        keep: bool,
    ) -> Coarse | None:
        types, field, n = self._cloud.field.types, self._cloud.field, len(points)
        lights = [self._lights[light] for _, light in pairs]
        toward = np.concatenate([self._eyes[e].toward(points) for e, _ in pairs])
        omegas = np.repeat([light.omega for light in lights], n, axis=0)
        where = np.tile(points, (len(pairs), 1))
        x, omega = vectors_of(types, where), vectors_of(types, omegas)
        depth = np.array(optical_depth(field, x, omega, types.Float(0), types.Float(math.inf), types.Bool(True), _DEEP))
        if not self._between.learned:
            some = np.linspace(0, len(where) - 1, min(len(where), TOLD)).astype(np.int64)
            told, *_ = self._ask(where[some], toward[some], omegas[some], self._between.albedos, depth[some], None, False)
            self.queries += told.size
            self._between.learn(told)
        albedos, columns, square = self._at(points, len(pairs))
        j, errors, made = self._ask(where, toward, omegas, albedos, depth, coarse, keep)
        self.queries += j.size
        j, errors = self._between.filled(j, errors)
        self.spared += j.size - len(where) * len(albedos)
        j, errors = (v[:, columns].reshape(len(pairs), n, -1) * square for v in (j, errors))
        x = vectors_of(types, points)
        for (e, _), light, values, expected in zip(pairs, lights, j, errors, strict=True):
            arriving = light.at(x)
            dr.eval(arriving)
            for f, k in enumerate(self._of_field):
                if k >= 0:
                    irradiance = np.array(arriving[f if self._brightest < 0 else self._brightest])
                    total[e, chosen, f] += irradiance * values[:, k]
                    # Errors of several lights add up: what makes a network err under one sun does so under the next.
                    error[chosen] += irradiance * expected[:, k]
        return made

    def _ask(
        self, where: Array, toward: Array, omegas: Array, albedos: Albedos, depth: Array, coarse: Coarse | None, keep: bool
    ) -> tuple[Array, Array, Coarse | None]:
        """Values of j and errors (n, albedos) at n points, with what corners tell of `coarse` levels; and what is to be kept of them."""
        n, types = len(where), self._cloud.field.types
        j, errors = np.empty((2, n, len(albedos)), np.float32)
        made: Coarse | None = None
        apart, together = np.arange(0 if keep else n), np.arange(n if keep else 0)
        if coarse is not None:
            told = _between(coarse, toward, omegas, depth)
            apart, together = np.flatnonzero(~told), np.flatnonzero(told)

        def of(chosen: Array) -> tuple[Any, Any, Any, Phase, Albedos, Any]:
            x, d, omega = (vectors_of(types, v[chosen]) for v in (where, toward, omegas))
            own = [a[chosen] if isinstance(a, np.ndarray) else a for a in albedos]
            return x, d, omega, self._cloud.phase, own, lanes_of(types.Float, depth[chosen])

        if len(apart) and self.carried:
            j[apart], errors[apart] = self._network.with_errors(*of(apart))
        elif len(apart):
            j[apart], errors[apart] = self._network(*of(apart)), 0
        if len(together):
            known = None if coarse is None else coarse.take(together)
            j[together], errors[together], found = self._network.shared(*of(together), self._levels, known, bool(self.carried))
            made = found if keep else None
            self.shared += 0 if keep else len(together) * len(albedos)
        return j, errors, made

    def _at(self, points: Array, times: int) -> tuple[Albedos, list[int], Array]:
        """The albedos to ask for at points that are repeated, which of all each field has, and what its values are multiplied by.

        A network knows one albedo a query. Where it varies, that is its mean over the medium around the point: walks correct the rest.
        """
        varying, field = self._cloud.varying, self._cloud.field
        if varying is None:
            return self._between.asked, list(range(len(self._between.albedos))), np.ones(1)
        types, n = field.types, len(points)
        own = on_host(self._cloud.albedo_at(vectors_of(types, points)), n)
        around = np.random.default_rng(_AROUND).normal(size=(_AROUND, 3)) * (_REACH * self._network.descriptor.unit)
        places = vectors_of(types, (points[:, None] + around).reshape(-1, 3))
        sigma = np.array(field.sigma_t(places), np.float64).reshape(n, _AROUND, 1)
        # Where nothing is near, as if there were.
        sigma += 1e-3 * max(field.majorant, 1e-30)
        mean = (on_host(varying(places), n * _AROUND).reshape(n, _AROUND, -1) * sigma).sum(axis=1) / sigma.sum(axis=1)
        columns: list[int] = []
        albedos: list[Array] = []
        for c in range(mean.shape[1]):
            same = [k for k in range(c) if np.array_equal(mean[:, k], mean[:, c])]
            columns.append(columns[same[0]] if same else len(albedos))
            if not same:
                albedos.append(np.clip(np.tile(mean[:, c], times), 0, 1))
        return albedos, columns, own * mean


def _between(coarse: Coarse, toward: Array, omegas: Array, depth: Array) -> NDArray[np.bool_]:
    """Which of n points the corners around them tell about: `coarse` is interpolated, view and light are (n, 3), optical depths (n,)."""
    # Where the view is along the light a stencil may stand at any angle around it.
    sine = np.linalg.norm(np.cross(toward, omegas), axis=1)
    # And a point at an edge may see the light when its corners do not.
    result: NDArray[np.bool_] = (sine > _ALONG) & (np.abs(np.log1p(depth) - coarse.depth) < _UNEXPECTED)
    return result


def _tint(lights: Sequence[Arriving]) -> Array | None:
    """Colour that all lights share, or None where their colours differ."""
    if not all(light.plain for light in lights):
        return None
    irradiance = np.array([light.irradiance for light in lights], np.float64)
    tint = irradiance[0] / irradiance[0].max()
    return tint if np.allclose(irradiance, irradiance.max(axis=1, keepdims=True) * tint, rtol=1e-5, atol=0) else None
