"""From a file or a loaded scene to a `Renderer`."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np

from deepclouds.errors import InputError
from deepclouds.medium.albedo import AlbedoGrid
from deepclouds.volume import read_volume
from deepclouds_runtime._mitsuba import mitsuba
from deepclouds_runtime.key_frames import Fixed, read_frame, with_extinction, without_cloud
from deepclouds_runtime.lights import luminance
from deepclouds_runtime.renderer import Renderer
from deepclouds_runtime.scattering import Predicts
from deepclouds_runtime.scene import CloudScene, read_scene
from deepclouds_runtime.volume_scene import options_from, volume_scene

_LOG = logging.getLogger(__name__)

# How a render is done, whatever the input.
RENDER_OPTIONS = ("mode", "unbiased", "exact_orders", "environment_directions", "interreflection", "extrapolate", "unit")
_MOST_THREADS = 1024
SCENE_OPTIONS = ("sensor", "max_depth", "hide_emitters")


def load(
    source: Any,
    *,
    defines: Mapping[str, str] | None = None,
    model: str | PathLike[str] | None = None,
    predictor: Predicts | None = None,
    quick: Callable[[], Predicts] | None = None,
    threads: int | None = None,
    grid: str | None = None,
    clamp: bool = False,
    albedo_grid: str | None = None,
    ignore_emission: bool = False,
    fixed: Fixed | None = None,
    turn: int = 1,
    **options: Any,
) -> Renderer:
    """Load what can be rendered.

    Parameters
    ----------
    source
        a path to a Mitsuba scene (.xml) or a volume (.vdb, .vol), or a ``mitsuba.Scene`` that is loaded already.
    defines
        values for the parameters (``$name``) of a Mitsuba scene file.
    model
        path or name of the network; None takes the one that comes with the package, and so does its name: then corrected images ask the
        small one about light from all around.
    predictor
        any object with ``predict``, in place of `model`.
    quick
        with `predictor`: loads a quicker one, see `Renderer`.
    threads
        threads for everything; None takes all cores.
    grid, clamp
        name of the grid in a .vdb file; set negative values and NaN to 0.
    albedo_grid
        name of a grid of the .vdb file, of floats or colours, that is the single-scattering albedo.
    ignore_emission
        render what the cloud scatters where a .vdb file says that it gives off light of its own, in place of refusing it.
    fixed
        what stays the same over the sequence that a volume belongs to, see `deepclouds_runtime.key_frames`.
    turn
        frames of a full turn around a volume, all of which the camera's distance suits, see `deepclouds_runtime.turntable`.
    **options
        for a volume: the fields of `deepclouds_runtime.volume_scene.VolumeOptions`; for a scene: ``sensor``, ``max_depth``,
        ``hide_emitters``; for both: ``mode``, ``unbiased``, ``exact_orders``, ``environment_directions``, ``interreflection``,
        ``extrapolate``, ``unit`` (see `Renderer`).

    Returns
    -------
    Renderer

    Raises
    ------
    InputError
        for missing or malformed files, options that do not fit, and everything the readers refuse.

    Notes
    -----
    Given a path while no Mitsuba variant is set, it sets ``llvm_ad_rgb``; a variant that is set is kept.
    """
    started = time.perf_counter()
    # A missing file is worth knowing before seconds of start-up.
    is_path = isinstance(source, str | PathLike)
    path = Path(source) if is_path else None
    if path is not None and not path.is_file():
        raise InputError(f"{path}: no such file")
    how = {name: options.pop(name) for name in RENDER_OPTIONS if name in options}
    if how.get("unbiased") and model is not None:
        raise InputError(f"model = '{model}': an unbiased render asks no network; leave one of the two out")
    mitsuba(select=is_path)
    if threads is not None:
        _set_threads(threads)
    scene = _scene(source, path, dict(defines or {}), grid, clamp, albedo_grid, ignore_emission, fixed, turn, options)
    if predictor is None and scene.max_depth != 2 and not how.get("unbiased"):
        from deepclouds_runtime.predictor import RELEASED, Predictor

        predictor = Predictor(None if model is None else fspath(model), threads)
        if model in (None, RELEASED[0]) and (scene.environment is not None or scene.surfaces is not None):
            # Frames of a sequence share it.
            quick = cache(partial(Predictor, RELEASED[-1], threads))
    if fixed is not None:
        how = {"unit": fixed.unit, "origin": fixed.origin, "longest": fixed.longest, **how}
    return Renderer(scene, predictor, quick, load_seconds=time.perf_counter() - started, **how)


def _set_threads(threads: int) -> None:
    import drjit as dr

    if threads < 1:
        raise InputError(f"threads = {threads}: at least one is needed")
    if threads > _MOST_THREADS:
        raise InputError(f"threads = {threads}: at most {_MOST_THREADS}; more than there are processors only slow the render down")
    dr.set_thread_count(threads)


def _scene(
    source: Any,
    path: Path | None,
    defines: dict[str, str],
    grid: str | None,
    clamp: bool,
    albedo_grid: str | None,
    ignore_emission: bool,
    fixed: Fixed | None,
    turn: int,
    options: dict[str, Any],
) -> CloudScene:
    if path is not None and path.suffix.lower() in (".vdb", ".vol"):
        if defines:
            raise InputError(f"{path}: -D{next(iter(defines))} has no meaning for a volume; it sets a parameter of a scene file")
        wanted = options_from(options)
        volume = read_volume(path, grid, clamp) if fixed is None else read_frame(path, grid, clamp)
        varying = None if albedo_grid is None or volume is None else _albedo(path, albedo_grid, "albedo" in options)
        if volume is None:
            assert fixed is not None
            volume = without_cloud(fixed)
        notes = _left_out(path, grid, albedo_grid, ignore_emission)
        if fixed is None:
            scene = volume_scene(volume, wanted, str(path), turn=turn)
        else:
            scene = volume_scene(volume, with_extinction(wanted, fixed), str(path), fixed.corners, turn)
        if varying is not None:
            scene = replace(scene, albedo=varying.largest, varying=varying)
        return replace(scene, notes=scene.notes + notes)
    if path is not None and path.suffix.lower() != ".xml":
        raise InputError(f"{path}: deepclouds renders Mitsuba scenes (.xml) and volumes (.vdb, .vol), not '{path.suffix}'")
    unknown = sorted(set(options) - set(SCENE_OPTIONS))
    if unknown:
        raise InputError(f"{path or 'the scene'}: the option '{unknown[0]}' belongs to a volume; a scene says it itself")
    if grid is not None or clamp or albedo_grid is not None or ignore_emission:
        raise InputError(
            f"{path or 'the scene'}: grid, clamp, albedo_grid and ignore_emission belong to a volume; a scene says itself what it reads"
        )
    if path is None:
        return read_scene(source, **options)
    scene = load_xml(path, defines)
    try:
        return read_scene(scene, **options)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _albedo(path: Path, grid: str, given: bool) -> AlbedoGrid:
    """The albedo that a grid of the file holds, one value for each colour channel."""
    if given:
        raise InputError(f"albedo_grid = '{grid}': the albedo is given too; leave one of the two out")
    if path.suffix.lower() != ".vdb":
        raise InputError(f"albedo_grid = '{grid}': {path} has one grid, its density; a .vdb file may hold an albedo as well")
    # Loads the native module, so only here.
    from deepclouds.volume.vdb import read_vdb_values

    values, to_world = read_vdb_values(path, grid)
    channels = len(mitsuba().Spectrum())
    if values.shape[3] not in (1, channels):
        values = luminance(values)[..., None].astype(np.float32)
    try:
        return AlbedoGrid(np.broadcast_to(values, (*values.shape[:3], channels)), to_world)
    except InputError as error:
        raise InputError(f"{path}: the grid '{grid}': {error}") from error


def _left_out(path: Path, grid: str | None, albedo: str | None, ignore: bool) -> tuple[str, ...]:
    """Sentences about a file's other grids; raises InputError for those that give off light, unless we are told to `ignore` it."""
    if path.suffix.lower() != ".vdb":
        return ()
    # Loads the native module, so only here.
    from deepclouds.volume.emission import emissive_grids
    from deepclouds.volume.vdb import chosen_grid

    notes = []
    headers, chosen = chosen_grid(path, grid)
    light = emissive_grids(path, grid)
    used = (chosen, *(k for k, h in enumerate(headers) if albedo in (h["unique_name"], h["name"])))
    others = [h["unique_name"] for k, h in enumerate(headers) if k not in used and h["unique_name"] not in light]
    if light and not ignore:
        raise InputError(
            f"{path}: by its {_named(light)} the cloud gives off light of its own, which deepclouds does not render; "
            "ignore_emission (--ignore-emission) renders what it scatters alone"
        )
    if light:
        notes.append(f"light that the cloud gives off by its {_named(light)} is left out")
    if others:
        rendered = " and ".join(repr(headers[k]["unique_name"]) for k in used)
        notes.append(f"of the file {rendered} alone {'is' if len(used) == 1 else 'are'} rendered, without its {_named(others)}")
    for note in notes:
        _LOG.info("%s: %s", path, note)
    return tuple(notes)


def _named(names: Sequence[str]) -> str:
    return f"grid{'s' if len(names) > 1 else ''} {', '.join(repr(name) for name in names)}"


def load_xml(path: Path, defines: dict[str, str]) -> Any:
    """Mitsuba's scene from a file; raises InputError in place of Mitsuba's own errors."""
    mi = mitsuba()
    try:
        return mi.load_file(str(path), **{name: str(value) for name, value in defines.items()})
    except (RuntimeError, TypeError) as error:
        message = " ".join(str(error).split())
        if "unused parameters" in message:
            raise InputError(
                f"{path}: the scene has no such parameter: {message.rpartition('parameters:')[2].strip(' -')}; leave it out"
            ) from error
        raise InputError(f"{path}: Mitsuba cannot load the scene: {message}") from error
