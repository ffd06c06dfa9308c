"""The labels of `deepclouds.medium.multiple_scattering` once more, by Mitsuba's ``volpath``: slower, and written by others.

The generator offers it as a second tracer, and the tests hold the two together.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepclouds.errors import InputError
from deepclouds.medium.phase import as_lobes
from deepclouds.volume import Volume

# Paths in flight at once; volpath keeps some 200 bytes for each.
_WAVEFRONT = 1 << 20


def trace_walks_mitsuba(
    volume: Volume,
    scale: float,
    points: NDArray[np.float32],
    directions: NDArray[np.float32],
    phase: NDArray[np.float32],
    suns: NDArray[np.float32],
    albedos: NDArray[np.float32],
    walks: int,
    seed: int,
) -> NDArray[np.float32]:
    """Unbiased estimates of ``4 pi J / (albedo^2 E)`` by Mitsuba, one for every walk.

    Each walk samples ``w'`` from Mitsuba's phase function around `directions` and follows it with ``volpath``; a sun is a delta light
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
    float32 array (n, walks, k, m). Unlike those of `trace_walks`, walks of different suns and albedos are independent.

    Raises
    ------
    InputError
        when Mitsuba's variant is not set or is none of the ``llvm`` and ``cuda`` variants of ``rgb`` or ``mono``; for an albedo outside
        of (0, 1] or a phase function that is none.

    Notes
    -----
    There is one scene for every different (phase function, sun, albedo): share them between points wherever speed matters.
    Roulette is off (it counts null collisions and would end paths at albedo 1) and so is the limit of the depth.
    """
    mi = _mitsuba()
    points, directions = np.asarray(points, np.float32), np.asarray(directions, np.float32)
    suns, albedos = np.asarray(suns, np.float32), np.asarray(albedos, np.float32)
    n, k_suns, m_albedos = len(points), suns.shape[1], albedos.shape[1]
    bad = albedos[~((albedos > 0) & (albedos <= 1))]
    if bad.size:
        raise InputError(f"albedo {bad[0]} is not in (0, 1]: Mitsuba's labels divide by it")
    try:
        lobes = as_lobes(phase)
    except ValueError as error:
        raise InputError(str(error)) from None
    result = np.zeros((n, walks, k_suns, m_albedos), np.float32)
    if result.size == 0 or scale * float(volume.density.max()) == 0:
        return result

    row, sun, column = (a.ravel() for a in np.indices((n, k_suns, m_albedos)))
    # volpath believes what it is told of the medium it starts in, so that is decided by geometry.
    unit = (points.astype(np.float64) - volume.to_world[:3, 3]) @ np.linalg.inv(volume.to_world[:3, :3]).T
    inside = np.all((unit > 0) & (unit < 1), axis=1)
    keys = np.column_stack([lobes[row], suns[row, sun], albedos[row, column], inside[row]]).astype(np.float32)
    different, group = np.unique(keys, axis=0, return_inverse=True)
    streams = iter(np.random.SeedSequence(seed).generate_state(len(row), np.uint32))
    portion = max(1, _WAVEFRONT // walks)
    for index, key in enumerate(different):
        members = np.flatnonzero(group.ravel() == index)
        scene = mi.load_dict(scene_dict(volume, scale, key[:3], key[3:6], float(key[6])))
        for start in range(0, len(members), portion):
            chosen = members[start : start + portion]
            rows = row[chosen]
            radiance = _trace(mi, scene, bool(key[7]), points[rows], directions[rows], walks, int(next(streams)))
            # E = 1, and J = albedo * radiance: of the two powers of the albedo in the label one cancels.
            result[rows, :, sun[chosen], column[chosen]] = 4 * np.pi * radiance / key[6]
    return result


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
    g1, g2, weight = (float(v) for v in as_lobes(np.atleast_1d(phase) if np.ndim(phase) == 0 else np.asarray(phase)[None])[0])
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


def _mitsuba() -> Any:
    """Mitsuba under a variant that computes many paths at once, and in which grey stays grey."""
    import mitsuba as mi

    variant = mi.variant()
    if variant is None or not (mi.is_rgb or mi.is_monochromatic) or not variant.startswith(("llvm", "cuda")) or "polarized" in variant:
        raise InputError(
            f"Mitsuba's variant is {variant}: labels need llvm_ad_rgb, llvm_ad_mono, cuda_ad_rgb or cuda_ad_mono; call mitsuba.set_variant"
        )
    return mi


def _trace(
    mi: Any, scene: Any, inside: bool, points: NDArray[np.float32], directions: NDArray[np.float32], walks: int, seed: int
) -> NDArray[np.float32]:
    """Radiance that has scattered at least once, along directions drawn from the phase function: (n, walks)."""
    import drjit as dr

    n = len(points)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, n * walks)
    medium = scene.shapes()[0].interior_medium()

    at = np.repeat(points.T, walks, axis=1)
    travel = np.repeat(directions.T, walks, axis=1)
    w = mi.Vector3f(np.ascontiguousarray(travel))
    interaction = dr.zeros(mi.MediumInteraction3f, n * walks)
    interaction.t = dr.full(mi.Float, 1.0, n * walks)
    interaction.p = mi.Point3f(np.ascontiguousarray(at))
    interaction.wi = -w
    interaction.sh_frame = mi.Frame3f(interaction.wi)
    wo, _, _ = medium.phase_function().sample(mi.PhaseFunctionContext(sampler), interaction, sampler.next_1d(), sampler.next_2d())

    ray = mi.RayDifferential3f(interaction.p, wo)
    radiance, _, _ = scene.integrator().sample(scene, sampler, ray, medium if inside else None)
    values = radiance if mi.is_monochromatic else radiance[0]
    return np.array(values, np.float32).reshape(n, walks)
