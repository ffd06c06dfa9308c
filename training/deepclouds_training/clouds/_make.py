"""The families by name, and the one function that makes a cloud of any of them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from deepclouds.errors import InputError
from deepclouds.volume import Volume
from deepclouds_training.clouds import (
    altocumulus,
    block,
    cirrus,
    congestus,
    cumulonimbus,
    cumulus,
    cumulus_field,
    fractus,
    pair,
    plume,
    pyro,
    shapes,
    stratocumulus,
    stratus,
)
from deepclouds_training.clouds._parameters import Choice, CloudParameters, Range, domains, named_streams, resolve
from deepclouds_training.clouds._raster import Field, rasterise

_ATTEMPTS = 16
COARSEST = 8
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Family:
    """One kind of cloud.

    Parameters
    ----------
    name, summary
        its name, and a line about it.
    parameters
        frozen dataclass of its parameters; `ranges` gives their domains.
    build
        from parameters and named random streams to a density over space.
    optical_depth
        of a thick column of such a cloud, vertically: what previews show.
    """

    name: str
    summary: str
    parameters: type[CloudParameters]
    build: Callable[[Any, Callable[[str], Any]], Field]
    optical_depth: float

    @property
    def ranges(self) -> dict[str, Range | Choice]:
        """Domain of each parameter."""
        return domains(self.parameters)


_ALL = (
    Family("cumulus", "a heap with a flat base and a cauliflower top, humilis to mediocris", cumulus.CumulusParameters, cumulus.build, 25),
    Family("cumulus_field", "many separate cumuli on one base level", cumulus_field.CumulusFieldParameters, cumulus_field.build, 15),
    Family("congestus", "a tall tower of rising bulbs, without an anvil", congestus.CongestusParameters, congestus.build, 60),
    Family("cumulonimbus", "a deep tower under an anvil", cumulonimbus.CumulonimbusParameters, cumulonimbus.build, 100),
    Family("stratus", "an even layer, closed or nearly so", stratus.StratusParameters, stratus.build, 10),
    Family(
        "stratocumulus",
        "a deck of closed cells with gaps, of open cells or of rolls",
        stratocumulus.StratocumulusParameters,
        stratocumulus.build,
        14,
    ),
    Family("altocumulus", "a sheet of many small rounded elements, often in rows", altocumulus.AltocumulusParameters, altocumulus.build, 8),
    Family("cirrus", "ice drawn out by the wind into long fibres", cirrus.CirrusParameters, cirrus.build, 1.5),
    Family("fractus", "wind-torn shreds with strong contrast of density", fractus.FractusParameters, fractus.build, 6),
    Family("pyro", "the rolling cloud of a fire or an explosion", pyro.PyroParameters, pyro.build, 50),
    Family("plume", "buoyant smoke that rolls up into swirls", plume.PlumeParameters, plume.build, 20),
    Family("shapes", "simple shapes, homogeneous or graded, hard or soft", shapes.ShapesParameters, shapes.build, 25),
    Family("block", "a homogeneous or graded block or layer that fills its box", block.BlockParameters, block.build, 25),
    Family("pair", "two bodies, each in the other's light and shadow", pair.PairParameters, pair.build, 30),
)
FAMILIES: dict[str, Family] = {family.name: family for family in _ALL}
HELD_OUT: tuple[str, ...] = ("congestus", "plume")
# Media that are not clouds but have a scene's hard shadows, wide layers and depths; data sets name them, they are no default.
SUPPLEMENT: tuple[str, ...] = ("block", "pair")
TRAINING: tuple[str, ...] = tuple(name for name in FAMILIES if name not in HELD_OUT + SUPPLEMENT)


def find_family(name: str) -> Family:
    """Return the family called `name`; InputError when there is none."""
    if name not in FAMILIES:
        raise InputError(f"unknown cloud family '{name}'; there are: {', '.join(FAMILIES)}")
    return FAMILIES[name]


def draw_parameters(family: str, seed: int, **parameters: Any) -> CloudParameters:
    """All parameters of the cloud that `make_cloud` makes from the same arguments."""
    kind = find_family(family)
    return resolve(kind.parameters, family, parameters, named_streams(seed, family, "parameters"))


def make_cloud(family: str, seed: int, resolution: int, **parameters: Any) -> Volume:
    """Make one cloud: the same arguments give the same bytes.

    Parameters
    ----------
    family
        one of `FAMILIES`.
    seed
        root of every random number, not negative.
    resolution
        samples along the most finely divided axis, at least 8; details grow with it, the form stays.
    parameters
        values by name, within the family's ranges; those not given are drawn from their ranges with the seed.

    Returns
    -------
    Volume
        density with maximum 1 (relative extinction), in a box centred on the origin whose longest side is 2 world units, Y up.

    Raises
    ------
    InputError
        for an unknown family or parameter, a value outside its range, a negative seed or a resolution below 8.
    """
    kind = find_family(family)
    if seed < 0:
        raise InputError(f"seed = {seed} is negative; it takes 0 or more")
    if resolution < COARSEST:
        raise InputError(f"resolution = {resolution} is too coarse for a cloud; it takes {COARSEST} or more")
    values = draw_parameters(family, seed, **parameters)
    for attempt in range(_ATTEMPTS):
        volume = rasterise(kind.build(values, named_streams(seed, family, f"attempt {attempt}")), resolution, values.voxel_aspect)
        if volume is not None:
            return volume
        _log.debug("%s with seed %d came out empty at attempt %d", family, seed, attempt)
    raise InputError(
        f"{family} with seed {seed} and {values} stays empty after {_ATTEMPTS} attempts; choose another seed or milder parameters"
    )
