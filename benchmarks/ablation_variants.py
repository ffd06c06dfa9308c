"""The variants that `python -m benchmarks.ablations` trains side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from deepclouds_training.network import Network, NetworkConfig

from benchmarks.ablation_networks import PHASE_COLUMNS, TAU_COLUMNS, Blind, DiffusionRatio, PooledAtOnce, Shared
from deepclouds.model import LEVELS


@dataclass(frozen=True)
class Variant:
    """One row of the table.

    Attributes
    ----------
    name, group, what
        short name, heading it stands under, and how it departs from the base, in words.
    build
        makes a network with random weights from torch's stream.
    powers
        the loss: shares of relative squared errors of different powers.
    furnace
        weight of the furnace identity in the loss.
    """

    name: str
    group: str
    what: str
    build: Callable[[], Network]
    powers: tuple[tuple[float, float], ...] = ((1.5, 1.0),)
    furnace: float = 0.0


def _config(width: int = 64, **fields: object) -> NetworkConfig:
    return NetworkConfig.model_validate({"width": width, "compression": "root", **fields})


def _plain(width: int = 64, **fields: object) -> Callable[[], Network]:
    return lambda: Network(_config(width, **fields))


def _best(width: int = 64, **fields: object) -> Callable[[], Network]:
    return _plain(width, **{"scale": "density", "head": "octaves", **fields})


BASE = "base"
FURNACE_WEIGHT = 0.2
FAST = "small networks"

SEPARATE: tuple[Variant, ...] = (
    Variant(BASE, "base", "width 64, coarse first, a block a level, root of the depth, all features, power 1.5", _plain()),
    Variant("fine first", "levels", "blocks from the finest level to the coarsest", _plain(order="fine_first")),
    Variant("shared 64", "levels", "one block for all levels, with a code of the level", lambda: Shared(_config())),
    Variant("shared 128", "levels", "the same, width 128", lambda: Shared(_config(128))),
    Variant("without finest", "levels", "level 0 is not read", _plain(levels=tuple(range(1, LEVELS)))),
    Variant("without coarsest", "levels", "level 9 is not read", _plain(levels=tuple(range(LEVELS - 1)))),
    Variant("no tau", "inputs", "no optical depth toward the sun", lambda: Blind(_config(), TAU_COLUMNS)),
    Variant("no phase features", "inputs", "the raw angle, its cosine, g and the weight alone", lambda: Blind(_config(), PHASE_COLUMNS)),
    Variant("density", "inputs", "the root of the density in the place of the depth", _plain(scale="density")),
    Variant("log", "inputs", "the logarithm in the place of the root", _plain(compression="log")),
    Variant("symmetric", "inputs", "every block sees the stencil and its mirror image", _plain(symmetric=True)),
    Variant("power 0", "loss", "absolute squared error", _plain(), powers=((0.0, 1.0),)),
    Variant("power 1", "loss", "power 1", _plain(), powers=((1.0, 1.0),)),
    Variant("power 2", "loss", "power 2", _plain(), powers=((2.0, 1.0),)),
    Variant("mixture", "loss", "half power 1, half power 2", _plain(), powers=((1.0, 0.5), (2.0, 0.5))),
    Variant("furnace", "loss", f"furnace identity with weight {FURNACE_WEIGHT:g}", _plain(), furnace=FURNACE_WEIGHT),
    Variant("ratio to octaves", "head", "ratio to three octaves", _plain(head="octaves")),
    Variant("ratio to diffusion", "head", "ratio to a diffusion estimate", lambda: DiffusionRatio(_config())),
    Variant("width 32", "width", "width 32", _plain(32)),
    Variant("width 128", "width", "width 128", _plain(128)),
    Variant("blocks 20", FAST, "a block a level, width 20", _plain(20)),
    Variant("half the levels", FAST, "levels 0, 2, 4, 6 and 8, width 32", _plain(32, levels=(0, 2, 4, 6, 8))),
    Variant("shared 48", FAST, "one block for all levels, width 48", lambda: Shared(_config(48))),
    Variant("pooled 16", FAST, "16 pooled values a level, then layers of 96", lambda: PooledAtOnce(_config(96, channels=16))),
    Variant("pooled 24", FAST, "24 pooled values a level, then layers of 88", lambda: PooledAtOnce(_config(88, channels=24))),
    Variant("pooled blocks", FAST, "24 pooled values a level, then blocks of 36", _plain(36, channels=24)),
)

EVEN = (0, 2, 4, 6, 8)

# What won above, together; the first row is the base once more, for the comparison.
TOGETHER: tuple[Variant, ...] = (
    Variant(BASE, "base", "as above", _plain()),
    Variant("d + o", "together", "density, ratio to octaves", _best()),
    Variant("d + o + s", "together", "density, ratio to octaves, symmetric", _best(symmetric=True)),
    Variant("d + o + log", "together", "density, ratio to octaves, logarithm", _best(compression="log")),
    Variant("d + o + s 128", "together", "density, ratio to octaves, symmetric, width 128", _best(128, symmetric=True)),
    Variant("pooled blocks d + o", FAST, "24 pooled values a level, blocks of 36, density, octaves", _best(36, channels=24)),
    Variant("pooled pairs", FAST, "16 pooled values a level, blocks of 40 for pairs", _best(40, channels=16, together=2)),
    Variant("pooled half 48", FAST, "16 pooled values of 5 levels, blocks of 48", _best(48, channels=16, levels=EVEN)),
    Variant("pooled half 40", FAST, "24 pooled values of 5 levels, blocks of 40", _best(40, channels=24, levels=EVEN)),
)
SETS: dict[str, tuple[Variant, ...]] = {"separate": SEPARATE, "together": TOGETHER}
