"""Where J comes from: the network in a render, Monte Carlo walks as its oracle in tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Protocol

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import rows
from deepclouds.descriptor import LEVELS, POINTS, Descriptor
from deepclouds.medium.field import Field
from deepclouds.medium.one_sun import trace_one_sun
from deepclouds.medium.phase import ordered_lobes
from deepclouds.model import aux_inputs
from deepclouds.model.trust import level_means

Phase = tuple[float, float, float]
Albedos = Sequence[float | NDArray[np.float64]]
# Stencils are 9 kB each: a chunk of them stays below 100 MB.
_CHUNK = 8192


class Stopped(Exception):
    """A prediction was given up because somebody asked for it."""


class MultipleScattering(Protocol):
    """Source of ``j = 4 pi J / (albedo^2 E)``."""

    def __call__(self, points: Any, w: Any, omega_sun: Any, phase: Phase, albedos: Albedos, tau: Any) -> NDArray[np.float32]:
        """Dimensionless j (n, albedos).

        Parameters
        ----------
        points, w, omega_sun
            Array3f: world points, unit directions of the camera rays' travel, unit vectors TOWARD the light.
        phase
            phase function (g1, g2, weight), see `deepclouds.medium.phase`.
        albedos
            the DIFFERENT albedos among the colour channels, each one value for all points, or one for each.
        tau
            Float: optical depth from the points toward the light.
        """
        ...


class Predicts(Protocol):
    """The one thing we ask of a network: see `deepclouds_runtime.predictor.Predictor`."""

    def predict(self, stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map stencils (n, 10, 225) and auxiliary inputs (n, 6) to j (n,)."""
        ...


class NetworkScattering:
    """J from the network: a stencil a point, one evaluation for each different albedo.

    Parameters
    ----------
    field
        the extinction.
    predictor
        the network.
    unit, origin
        see `deepclouds.descriptor.Descriptor`; fixed for a sequence of frames.

    Attributes
    ----------
    stop
        is asked before each batch whether to give up, by `Stopped`; None goes on.
    """

    def __init__(self, field: Field, predictor: Predicts, unit: float | None = None, origin: NDArray[np.float64] | None = None) -> None:
        self.descriptor = Descriptor(field, unit, origin)
        # What is built on the field is aligned to it too.
        self.anchor = origin
        self.stop: Callable[[], bool] | None = None
        self._types = field.types
        self._ask(predictor)

    def asking(self, predictor: Predicts) -> NetworkScattering:
        """The same with another network, which shares the filtered levels."""
        other = copy(self)
        other._ask(predictor)
        return other

    def _ask(self, predictor: Predicts) -> None:
        self.predictor = predictor
        trusted = getattr(getattr(predictor, "metadata", None), "trust", None) is not None
        self._errors: Callable[..., NDArray[np.float32]] | None = getattr(predictor, "errors", None) if trusted else None
        # Levels that the network does not look at are not built.
        self._read: Sequence[int] = getattr(predictor, "read", range(LEVELS))

    def __call__(self, points: Any, w: Any, omega_sun: Any, phase: Phase, albedos: Albedos, tau: Any) -> NDArray[np.float32]:
        """J of the points; see `MultipleScattering`."""
        return self._asked(_Query(points, w, omega_sun, phase, albedos, tau))[0]

    def with_errors(
        self, points: Any, w: Any, omega_sun: Any, phase: Phase, albedos: Albedos, tau: Any
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """J of the points, and the error to expect of each, both (n, albedos); only where `knows_errors`."""
        return self._asked(_Query(points, w, omega_sun, phase, albedos, tau), errors=self._errors)[:2]

    def shares(self, levels: int) -> bool:
        """Whether neighbours can share what the network makes of so many of the coarsest levels."""
        return self._halves(levels) is not None

    def shared(
        self,
        points: Any,
        w: Any,
        omega_sun: Any,
        phase: Phase,
        albedos: Albedos,
        tau: Any,
        levels: int,
        coarse: Coarse | None = None,
        errors: bool = False,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], Coarse]:
        """J of the points and errors, as `with_errors`, where neighbours share the coarsest `levels`.

        Parameters
        ----------
        points, w, omega_sun, phase, albedos, tau
            see `MultipleScattering`.
        levels
            see `shares`.
        coarse
            what the network made of these levels at the points; None has it made.
        errors
            whether errors are asked for, which are 0 else.

        Returns
        -------
        J and errors, both (n, albedos), and what the network made of the levels.
        """
        query = _Query(points, w, omega_sun, phase, albedos, tau)
        j, expected, coarse = self._asked(query, self._errors if errors else None, levels, coarse)
        assert coarse is not None
        return j, expected, coarse

    @property
    def knows_errors(self) -> bool:
        """Whether the network's file says how far its predictions can be trusted."""
        return self._errors is not None

    def _halves(self, levels: int) -> Any:
        found = getattr(self.predictor, "halves", None)
        return None if found is None or levels == 0 else found(levels)

    def _asked(
        self,
        query: _Query,
        errors: Callable[..., NDArray[np.float32]] | None = None,
        shared: int = 0,
        coarse: Coarse | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], Coarse | None]:
        """J and errors of a query; with `shared` levels also what the network made of these."""
        halves = self._halves(shared)
        # The arc cosine of a float32 cosine loses half of its digits near 0 and pi; the cross product keeps them.
        gamma = np.array(dr.atan2(dr.norm(dr.cross(query.w, query.omega_sun)), dr.dot(query.w, query.omega_sun)))
        depth = np.array(query.tau)
        n, albedos = len(gamma), query.albedos
        result = np.empty((n, len(albedos)), np.float32)
        expected = np.zeros((n, len(albedos)), np.float32)
        if self.descriptor.empty:
            result[:] = 0
            return result, expected, coarse
        own = LEVELS if coarse is None else LEVELS - shared
        # Errors depend on all levels.
        wanted = [k for k in range(own) if k in self._read or errors is not None]
        stencils = np.zeros((min(n, _CHUNK), own, POINTS), np.float32)
        made: list[Coarse] = []
        for start in range(0, n, _CHUNK):
            if self.stop is not None and self.stop():
                raise Stopped
            rows = slice(start, min(start + _CHUNK, n))
            x, w, omega = (_slice(self._types, v, rows.start, rows.stop) for v in (query.points, query.w, query.omega_sun))
            stencil = stencils[: rows.stop - start]
            for k, level in zip(wanted, self.descriptor.levels(x, w, omega, wanted=wanted), strict=True):
                stencil[:, k] = level.numpy().reshape(-1, POINTS)
            means = None if coarse is None else coarse.means[rows]
            latents = []
            for m, albedo in enumerate(albedos):
                of_point = albedo[rows] if isinstance(albedo, np.ndarray) else albedo
                aux = aux_inputs(gamma[rows], *ordered_lobes(query.phase), of_point, depth[rows])
                if halves is None:
                    j = self.predictor.predict(stencil, aux)
                elif coarse is None:
                    j, latent = halves.begin(stencil, aux)
                    latents.append(latent)
                else:
                    j = halves.finish(coarse.latent[rows, m], stencil, aux)
                result[rows, m] = j
                if errors is not None:
                    expected[rows, m] = errors(stencil, aux, j) if means is None else errors(stencil, aux, j, means)
            if latents:
                made.append(Coarse(np.stack(latents, axis=1), level_means(stencil[:, LEVELS - shared :]), np.log1p(depth[rows])))
        return result, expected, Coarse.joined(made) if made else coarse


@dataclass(frozen=True)
class Coarse:
    """What a network made of the coarse levels of n stencils.

    Attributes
    ----------
    latent
        (n, albedos, width): what its first half hands on.
    means
        (n, levels, 2): see `deepclouds.model.trust.level_means`.
    depth
        (n,) log(1 + optical depth toward the light).
    """

    latent: NDArray[np.float32]
    means: NDArray[np.float32]
    depth: NDArray[np.float32]

    def take(self, rows: NDArray[np.int64]) -> Coarse:
        """That of some of the stencils."""
        return Coarse(self.latent[rows], self.means[rows], self.depth[rows])

    def split(self, count: int) -> list[Coarse]:
        """`count` equal parts, in turn."""
        parts = (np.split(values, count) for values in (self.latent, self.means, self.depth))
        return [Coarse(*part) for part in zip(*parts, strict=True)]

    @classmethod
    def joined(cls, parts: Sequence[Coarse]) -> Coarse:
        """Several, one after the other."""
        return cls(*(np.concatenate(values) for values in zip(*((p.latent, p.means, p.depth) for p in parts), strict=True)))


@dataclass(frozen=True)
class _Query:
    """The arguments of `MultipleScattering`."""

    points: Any
    w: Any
    omega_sun: Any
    phase: Phase
    albedos: Albedos
    tau: Any


class WalkScattering:
    """J from Monte Carlo walks: unbiased and noisy, the oracle that a network is held against.

    Parameters
    ----------
    field
        the extinction.
    walks
        walks a query.
    seed
        root of the random streams; every call continues with streams of its own.
    """

    def __init__(self, field: Field, walks: int = 1, seed: int = 0) -> None:
        self._field, self._walks = field, walks
        self._streams = np.random.SeedSequence(seed)

    def __call__(self, points: Any, w: Any, omega_sun: Any, phase: Phase, albedos: Albedos, tau: Any) -> NDArray[np.float32]:
        """J of the points; see `MultipleScattering`."""
        x, d, suns = (rows(v) for v in (points, w, omega_sun))
        n = len(x)
        seed = int(self._streams.spawn(1)[0].generate_state(1, np.uint64)[0])
        values = trace_one_sun(
            self._field,
            x,
            d,
            np.broadcast_to(np.array(phase, np.float32), (n, 3)),
            np.broadcast_to(suns, (n, 3)),
            np.stack([np.broadcast_to(np.asarray(a, np.float32), n) for a in albedos], axis=1),
            self._walks,
            seed,
            roulette=True,
        )
        mean: NDArray[np.float32] = values.mean(axis=1)
        return mean


def _slice(types: ModuleType, vector: Any, start: int, stop: int) -> Any:
    if dr.width(vector) == 1:
        return vector
    index = dr.arange(types.UInt32, stop - start) + dr.opaque(types.UInt32, start)
    return types.Array3f(*(dr.gather(types.Float, c, index) if dr.width(c) > 1 else c for c in vector))
