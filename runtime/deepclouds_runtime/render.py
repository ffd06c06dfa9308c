"""`deepclouds render`, and the same as a Python function."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from deepclouds_runtime.result import RenderResult


def render(
    input: Any,
    spp: int | None = None,
    seed: int = 0,
    defines: Mapping[str, str] | None = None,
    model: str | PathLike[str] | None = None,
    progress: Callable[[float], None] | None = None,
    error: float | None = None,
    partial: Callable[[RenderResult], None] | None = None,
    interrupted: Callable[[], bool] | None = None,
    **options: Any,
) -> RenderResult:
    """Render a cloud with its multiple scattering predicted by the network.

    Parameters
    ----------
    input
        a path to a Mitsuba scene (.xml) or a volume (.vdb, .vol), or a loaded ``mitsuba.Scene``.
    spp
        samples a pixel; by default as many as `error` asks for.
    seed
        of all random numbers.
    defines
        values for the parameters of a scene file.
    model
        path of the network; None takes the one that comes with the package.
    progress
        is called with the share of the work done, 0 to 1.
    error
        noise of a pixel to aim at, root of the mean square over the mean (default 0.02).
    partial
        is called with the image so far, first with a quick look; see `deepclouds_runtime.renderer.Renderer.render`.
    interrupted
        is asked between passes whether to stop with what there is.
    **options
        see `deepclouds_runtime.loading.load`.

    Returns
    -------
    RenderResult
        image, its parts, seconds and counts; ``seconds["total"]`` leaves loading out.

    Raises
    ------
    InputError
        for bad files and values.

    Notes
    -----
    To render one scene several times, keep a `deepclouds_runtime.loading.load` and call its ``render``.
    """
    from deepclouds_runtime.loading import load

    return load(input, defines=defines, model=model, **options).render(spp, seed, progress, error, partial, interrupted)


def main(argv: Sequence[str], prog: str = "deepclouds render") -> int:
    """Run the command; see `deepclouds_runtime._command`."""
    from deepclouds_runtime._command import run

    return run(argv, prog)
