"""Where J comes from: the network in a render, Monte Carlo walks as its oracle in tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
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

    def __call__(self, points: Any, w: Any, omega_sun: Any, phase: Phase, albedos: Albedos, tau: Any) -> NDArray[np.float32]:
        """J of the points; see `MultipleScattering`."""
        return self._asked(points, w, omega_sun, phase, albedos, tau, None)[0]

    def with_errors(
        self, points: Any, w: Any, omega_sun: Any, phase: Phase, albedos: Albedos, tau: Any
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """J of the points, and the error to expect of each, both (n, albedos); only where `knows_errors`."""
        return self._asked(points, w, omega_sun, phase, albedos, tau, self._errors)

    @property
    def knows_errors(self) -> bool:
        """Whether the network's file says how far its predictions can be trusted."""
        return self._errors is not None

    def _asked(
        self,
        points: Any,
        w: Any,
        omega_sun: Any,
        phase: Phase,
        albedos: Albedos,
        tau: Any,
        errors: Callable[..., NDArray[np.float32]] | None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        # The arc cosine of a float32 cosine loses half of its digits near 0 and pi; the cross product keeps them.
        gamma = np.array(dr.atan2(dr.norm(dr.cross(w, omega_sun)), dr.dot(w, omega_sun)))
        depth = np.array(tau)
        n = len(gamma)
        result = np.empty((n, len(albedos)), np.float32)
        expected = np.zeros((n, len(albedos)), np.float32)
        if self.descriptor.empty:
            result[:] = 0
            return result, expected
        stencils = np.empty((min(n, _CHUNK), LEVELS, POINTS), np.float32)
        for start in range(0, n, _CHUNK):
            if self.stop is not None and self.stop():
                raise Stopped
            stop = min(start + _CHUNK, n)
            part = [_slice(self._types, v, start, stop) for v in (points, w, omega_sun)]
            stencil = stencils[: stop - start]
            for k, level in enumerate(self.descriptor.levels(*part)):
                stencil[:, k] = level.numpy().reshape(-1, POINTS)
            for m, albedo in enumerate(albedos):
                own = albedo[start:stop] if isinstance(albedo, np.ndarray) else albedo
                aux = aux_inputs(gamma[start:stop], *ordered_lobes(phase), own, depth[start:stop])
                result[start:stop, m] = j = self.predictor.predict(stencil, aux)
                if errors is not None:
                    expected[start:stop, m] = errors(stencil, aux, j)
        return result, expected


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
