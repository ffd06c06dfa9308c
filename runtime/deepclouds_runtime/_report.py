"""What `deepclouds render` says about a render, on the terminal and in the image's header."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from deepclouds.memory import gib
from deepclouds_runtime.error_parts import in_words

if TYPE_CHECKING:
    from deepclouds_runtime.renderer import Renderer
    from deepclouds_runtime.result import RenderResult


def describe(renderer: Renderer, say: Callable[[str], None]) -> None:
    """Say what will be rendered."""
    scene = renderer.scene
    x, y, z = scene.volume.resolution
    width, height = scene.size
    albedo = ", ".join(f"{a:g}" for a in scene.albedo)
    say(f"cloud of {x} x {y} x {z} voxels, extinction {scene.scale:.5g} at density 1, albedo {albedo}, {_phase_words(scene.phase)}")
    lights = [f"{len(scene.suns)} sun{'s' if len(scene.suns) > 1 else ''}"] if scene.suns else []
    lights += [scene.environment.class_name()] if scene.environment is not None else []
    say(f"image of {width} x {height} pixels; lights: {', '.join(lights) or 'none'}")
    for note in renderer.notes:
        say(f"note: {note}")


def report(result: RenderResult, say: Callable[[str], None]) -> None:
    """Say what a render took, as a table."""
    statistics = result.statistics
    rows = [("mode", statistics.mode), ("samples a pixel", f"up to {statistics.spp:,}, on average {statistics.mean_spp:.3g}")]
    rows += zip(("error: samples and interpolation", "error: network"), in_words(statistics.error), strict=True)
    what = "multiple scattering" if statistics.error.get("network", {}).get("by") == "none" else "the network"
    if statistics.network:
        rows.append(("error of the network, expected", f"{100 * statistics.network['error']:.2g} % of the cloud's light"))
    rows += list(_audit_rows(statistics.audit, what))
    for name, source in statistics.sources.items():
        took = f"{source['nodes']:,} nodes, {source['queries']:,} queries{_of(source['model'])}"
        took += f" ({source['shared']:,} of them in part)" if source["shared"] else ""
        took += f", error at a point {100 * source['error']:.2g} %"
        rows.append((f"{name} ({source['lights']})", f"{took}, cells refined {' + '.join(map(str, source['refined'])) or 0}"))
    counts = {name.replace("_", " "): count for name, count in asdict(result.counts).items() if name != "skipped"}
    if statistics.mode == "path-traced":
        counts["walks"] = counts.pop("queries")
    rows += [(name, f"{value:,}") for name, value in counts.items()]
    rows += [(f"no query: {name}", f"{value:,}") for name, value in statistics.skipped.items()]
    rows += [(f"memory: {name}", gib(count)) for name, count in statistics.memory.items()]
    rows += [(f"time: {name}", f"{seconds:.2f} s") for name, seconds in result.seconds.items()]
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        say(f"{name.ljust(width)}  {value}")


def _audit_rows(found: dict[str, Any], what: str) -> Iterator[tuple[str, str]]:
    """What the audit found, in lines; `what` was audited."""
    if not found:
        return
    yield f"error of {what}, measured", _measured(found["network"])
    if found["corrected"]:
        yield "error once corrected, measured", _measured(found["remaining"])
    yield "walks that measured it", f"{found['walks']:,}" + ("" if found["corrected"] else ", no correction made")


def _of(model: str) -> str:
    return f" of '{model}'" if model else ""


def _measured(error: dict[str, Any]) -> str:
    low, high = (100 * v for v in error["error_interval"])
    darker, brighter = (100 * v for v in error["energy_interval"])
    return (
        f"{100 * error['error']:.2g} % ({low:.2g} to {high:.2g} %) of regions of multiple scattering, "
        f"energy {100 * error['energy']:+.2g} % ({darker:+.2g} to {brighter:+.2g} %)"
    )


def settings(renderer: Renderer, correct: bool = False) -> dict[str, Any]:
    """Of the scene, what is needed to render the image again, one that walks `correct` or not."""
    import numpy as np

    from deepclouds_runtime._mitsuba import mitsuba

    scene = renderer.scene
    asked = not renderer.traces(correct)
    parameters = mitsuba().traverse(scene.sensor)
    camera: dict[str, Any] = {
        "type": scene.sensor.class_name(),
        "to_world": np.array(scene.sensor.world_transform().matrix, np.float64).reshape(4, 4).tolist(),
        "film": [int(v) for v in scene.sensor.film().size()],
        "crop_offset": [int(v) for v in scene.sensor.film().crop_offset()],
    }
    for name in ("x_fov", "aperture_radius", "focus_distance"):
        if name in parameters:
            camera[name] = [float(v) for v in np.ravel(np.array(parameters[name]))]
    return {
        "mitsuba_variant": mitsuba().variant(),
        "environment_directions": renderer.environment_directions,
        "size": scene.size,
        "camera": camera,
        "suns": [asdict(sun) for sun in scene.suns],
        "hide_emitters": scene.hide_emitters,
        "extinction": scene.scale,
        "unit": renderer.unit if asked else None,
        "albedo": scene.albedo,
        "phase": scene.phase,
        "max_depth": scene.max_depth,
        "model_hash": renderer.model_hash if asked else None,
    }


def noise_words(result: RenderResult) -> str:
    """Samples and noise of an image in a few words."""
    statistics = result.statistics
    noise = "" if statistics.noise is None else f", noise of about {100 * statistics.noise:.2g} %"
    return f"{statistics.mean_spp:.3g} samples a pixel{noise}"


def _phase_words(phase: tuple[float, float, float]) -> str:
    g1, g2, weight = phase
    return f"g {g1:g}" if weight == 1 else f"g {g1:g} and {g2:g} with weights {weight:g} and {1 - weight:g}"
