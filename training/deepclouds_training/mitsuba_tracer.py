"""The labels of `deepclouds.medium.multiple_scattering` once more, by Mitsuba's ``volpath``: slower, and written by others.

The generator offers it as a second tracer, the tests hold the two together, and the benchmark of labels measures what it costs.

J at a point is albedo times the mean radiance along directions w' drawn from the phase function around w. No sensor of Mitsuba draws
those, so every path gets a ``radiancemeter`` of its own whose direction is drawn beforehand, and a ``batch`` of them is rendered with one
sample a pixel: the loop over paths is Mitsuba's own, in C++ under a scalar variant, and the samples are independent and unbiased.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from deepclouds.errors import InputError
from deepclouds.medium.phase import as_lobes
from deepclouds.volume import Volume

Singles = NDArray[np.float32]
Doubles = NDArray[np.float64]
# A pixel's position in a wider film loses the digits that tell one meter from the next.
_WIDEST = 1 << 15


def trace_walks_mitsuba(
    volume: Volume,
    scale: float,
    points: Singles,
    directions: Singles,
    phase: Singles,
    suns: Singles,
    albedos: Singles,
    walks: int,
    seed: int,
) -> Singles:
    """Unbiased estimates of ``4 pi J / (albedo^2 E)`` by Mitsuba, one for every walk.

    Each walk samples ``w'`` from the phase function around `directions` and follows it with ``volpath``; a sun is a delta light
    that no ray can hit, so ``volpath`` returns exactly what has scattered at least once on its way to the point.

    Parameters
    ----------
    volume, scale
        density, and extinction per unit of density, 1 / world length.
    points
        (n, 3) world points, inside or outside of the box.
    directions
        (n, 3) unit vectors w, the camera ray's travel.
    phase
        (n, 3) lobes (g1, g2, weight), or (n,) Henyey-Greenstein parameters g of single lobes.
    suns
        (n, k, 3) unit vectors TOWARD the suns.
    albedos
        (n, m) single-scattering albedos in (0, 1]: the label at albedo 0 is a limit that ``volpath`` cannot form.
    walks
        walks per point.
    seed
        root of the random streams.

    Returns
    -------
    float32 array (n, walks, k, m). The walks of a point's suns and albedos leave it in the same directions, since meters are dear to
    load, and are independent from there on; those of `trace_walks` are the same walks.

    Raises
    ------
    InputError
        when Mitsuba's variant is not set, is polarized or spectral; for an albedo outside of (0, 1] or a phase function that is none.

    Notes
    -----
    There is one scene for every different phase function, and at least one batch of meters for every different (phase function, suns,
    albedos): share them between points wherever speed matters.
    Roulette is off (it counts null collisions and would end paths at albedo 1) and so is the limit of the depth.
    """
    _check_variant()
    points, directions = np.asarray(points, np.float32), np.asarray(directions, np.float32)
    suns, albedos = np.asarray(suns, np.float32), np.asarray(albedos, np.float32)
    n, k_suns, m_albedos = len(points), suns.shape[1], albedos.shape[1]
    bad = albedos[~((albedos > 0) & (albedos <= 1))]
    if bad.size:
        raise InputError(f"albedo {bad[0]} is not in (0, 1]: Mitsuba's labels divide by it")
    try:
        lobes = as_lobes(phase).astype(np.float32)
    except ValueError as error:
        raise InputError(str(error)) from None
    result = np.zeros((n, walks, k_suns, m_albedos), np.float32)
    if result.size == 0 or scale * float(volume.density.max()) == 0:
        return result

    rng = np.random.default_rng(seed)
    # volpath believes what it is told of the medium it starts in, so that is decided by geometry.
    keys = np.column_stack([lobes, holds(volume, points), suns.reshape(n, -1), albedos]).astype(np.float32)
    different, group = np.unique(keys, axis=0, return_inverse=True)
    scene: VolpathScene | None = None
    portion = max(1, _WIDEST // walks)
    for index, key in enumerate(different):
        # The keys are sorted by phase function, and loading a scene copies the grid.
        if scene is None or not np.array_equal(key[:3], different[index - 1][:3]):
            scene = VolpathScene(volume, scale, key[:3])
        members = np.flatnonzero(group.ravel() == index)
        for start in range(0, len(members), portion):
            rows = members[start : start + portion]
            meters = scene.meters(points[rows], draw_directions(rng, directions[rows], key[:3], walks), inside=bool(key[3]))
            for sun, omega_sun in enumerate(suns[rows[0]]):
                for column, albedo in enumerate(albedos[rows[0]]):
                    scene.light(omega_sun, float(albedo))
                    values = scene.labels(meters, int(rng.integers(2**32)))
                    result[rows, :, sun, column] = values.reshape(len(rows), walks)
    return result


class VolpathScene:
    """A volume under one sun, in which paths start at meters; sun and albedo may change.

    Parameters
    ----------
    volume, scale
        density, and extinction per unit of density, 1 / world length.
    phase
        lobes (g1, g2, weight), or the parameter g of a single lobe.
    """

    def __init__(self, volume: Volume, scale: float, phase: ArrayLike) -> None:
        import mitsuba as mi

        self._volume = volume
        # A scene made with an albedo of 1 has no parameter to change it by under some variants.
        self._albedo = 0.5
        self._scene = mi.load_dict(scene_dict(volume, scale, phase, [0.0, 0.0, 1.0], self._albedo))
        self._medium = self._scene.shapes()[0].interior_medium()
        self._film = {"type": "hdrfilm", "pixel_format": "luminance", "component_format": "float32", "rfilter": {"type": "box"}}
        self._pixel = mi.load_dict({**self._film, "width": 1, "height": 1})

    def light(self, omega_sun: ArrayLike, albedo: float) -> None:
        """Turn the sun to the unit vector TOWARD it, `omega_sun`, and set the single-scattering albedo."""
        import mitsuba as mi

        sun = np.asarray(omega_sun, np.float64)
        up = np.eye(3)[np.argmin(np.abs(sun))]
        parameters = mi.traverse(self._scene)
        # A directional light shines along +Z of its frame.
        parameters["sun.to_world"] = mi.ScalarTransform4f().look_at(
            origin=[0, 0, 0], target=[-float(v) for v in sun], up=[float(v) for v in up]
        )
        if albedo != self._albedo:
            parameters["box.interior_medium.albedo.value.value"] = albedo
            self._albedo = albedo
        parameters.update()

    def meters(self, points: Singles, directions: Doubles, inside: bool) -> list[Any]:
        """Sensors with a meter for each of the directions (n, walks, 3) that leave the points (n, 3), all in the box or all outside."""
        import mitsuba as mi

        # A meter's rays start this far beyond it, which is not little where a mean free path is short.
        ahead = float(mi.math.RayEpsilon)
        origins = (points.astype(np.float64)[:, None] - ahead * directions).reshape(-1, 3).tolist()
        travels = directions.reshape(-1, 3).tolist()
        sensors = []
        for start in range(0, len(origins), _WIDEST):
            end = min(start + _WIDEST, len(origins))
            batch: dict[str, Any] = {"type": "batch", "sampler": {"type": "independent"}}
            if inside:
                batch["medium"] = self._medium
            batch["film"] = {**self._film, "width": end - start, "height": 1}
            for i in range(start, end):
                batch[f"meter_{i}"] = {"type": "radiancemeter", "origin": origins[i], "direction": travels[i], "film": self._pixel}
            sensors.append(mi.load_dict(batch))
        return sensors

    def labels(self, meters: list[Any], seed: int) -> Doubles:
        """One sample of ``4 pi J / (albedo^2 E)`` for each meter; `seed` decides all but the meters' directions."""
        import mitsuba as mi

        seeds = np.random.SeedSequence(seed).generate_state(len(meters), np.uint32).tolist()
        images = [mi.render(self._scene, sensor=sensor, spp=1, seed=s) for sensor, s in zip(meters, seeds, strict=True)]
        # E = 1, and J = albedo * radiance: of the two powers of the albedo in the label one cancels.
        return (4 * np.pi / self._albedo) * np.concatenate([np.array(image, np.float64).ravel() for image in images])


def holds(volume: Volume, points: Singles) -> NDArray[np.bool_]:
    """Which of the world points (n, 3) lie strictly inside of the volume's box."""
    unit = (points.astype(np.float64) - volume.to_world[:3, 3]) @ np.linalg.inv(volume.to_world[:3, :3]).T
    inside: NDArray[np.bool_] = np.all((unit > 0) & (unit < 1), axis=1)
    return inside


def draw_directions(rng: Generator, w: Singles, phase: ArrayLike, walks: int) -> Doubles:
    """Directions (n, walks, 3) drawn around w (n, 3) from the phase function: lobes (g1, g2, weight), or the parameter g of a single one.

    It shares no code with `deepclouds.medium.phase`, as befits a second tracer.
    """
    g1, g2, weight = _lobes(phase)
    n = len(w)
    g = np.where(rng.random((n, walks)) < weight, g1, g2)
    u = rng.random((n, walks))
    # Henyey and Greenstein's function inverted; the limit of small g.
    small = np.abs(g) < 1e-4
    h = np.where(small, 1.0, g)
    cosine = np.where(small, 1 - 2 * u, (1 + h**2 - ((1 - h**2) / (1 - h + 2 * h * u)) ** 2) / (2 * h))
    azimuth = rng.uniform(0, 2 * np.pi, (n, walks))
    travel = w.astype(np.float64)
    a = np.cross(travel, np.eye(3)[np.argmin(np.abs(travel), axis=1)])
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(travel, a)
    across = np.cos(azimuth)[..., None] * a[:, None] + np.sin(azimuth)[..., None] * b[:, None]
    directions: Doubles = cosine[..., None] * travel[:, None] + np.sqrt(np.maximum(1 - cosine**2, 0))[..., None] * across
    return directions


def scene_dict(volume: Volume, scale: float, phase: ArrayLike, omega_sun: ArrayLike, albedo: float) -> dict[str, Any]:
    """Mitsuba scene (for ``load_dict``): the volume in its box under a sun of irradiance 1, and the integrator that is safe for it.

    Parameters
    ----------
    volume, scale
        density, and extinction per unit of density, 1 / world length.
    phase
        lobes (g1, g2, weight), or the parameter g of a single lobe.
    omega_sun
        unit vector TOWARD the sun.
    albedo
        single-scattering albedo, grey.
    """
    import mitsuba as mi

    # Mitsuba's cube spans [-1, 1]^3. It is symmetric, so a mirrored box is made of an unmirrored cube, whose normals point outward.
    half = np.diag([0.5, 0.5, 0.5, 1.0])
    half[:3, 3] = 0.5
    if np.linalg.det(volume.to_world[:3, :3]) < 0:
        half[0, 0] = -0.5
    grid = mi.VolumeGrid(np.ascontiguousarray(volume.density[..., None]))
    cube_to_world: Any = volume.to_world @ half
    return {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": -1, "rr_depth": 1_000_000},
        "sun": {
            "type": "directional",
            "direction": [-float(v) for v in np.asarray(omega_sun)],
            "irradiance": {"type": "uniform", "value": 1.0} if mi.is_spectral else _grey(mi, 1.0),
        },
        "box": {
            "type": "cube",
            "to_world": mi.ScalarTransform4f(cube_to_world),
            "bsdf": {"type": "null"},
            "interior": {
                "type": "heterogeneous",
                "sigma_t": {
                    "type": "gridvolume",
                    "grid": grid,
                    "raw": True,
                    "accel": False,
                    "filter_type": "trilinear",
                    "wrap_mode": "clamp",
                    "to_world": mi.ScalarTransform4f(np.array(volume.to_world)),
                },
                "albedo": {"type": "constvolume", "value": _grey(mi, albedo)},
                "scale": float(scale),
                "has_spectral_extinction": False,
                "phase": _phase_dict(phase),
            },
        },
    }


def _phase_dict(phase: ArrayLike) -> dict[str, Any]:
    g1, g2, weight = _lobes(phase)
    first = {"type": "hg", "g": g1}
    # blendphase's weight is that of its second phase function.
    second = {
        "type": "blendphase",
        "weight": {"type": "constvolume", "value": 1 - weight},
        "first": first,
        "second": {"type": "hg", "g": g2},
    }
    return first if weight == 1 else second


def _grey(mi: Any, value: float) -> Any:
    return {"type": "rgb", "value": [value] * 3} if mi.is_rgb else {"type": "uniform", "value": value}


def _lobes(phase: ArrayLike) -> tuple[float, float, float]:
    g1, g2, weight = (float(v) for v in as_lobes(np.atleast_1d(phase) if np.ndim(phase) == 0 else np.asarray(phase)[None])[0])
    return g1, g2, weight


def _check_variant() -> None:
    """Refuse variants in which grey does not stay grey."""
    import mitsuba as mi

    variant = mi.variant()
    if variant is None or not (mi.is_rgb or mi.is_monochromatic) or "polarized" in variant:
        raise InputError(f"Mitsuba's variant is {variant}: labels need one of rgb or mono, best scalar_rgb; call mitsuba.set_variant")
