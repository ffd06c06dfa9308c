"""The variants that `python -m benchmarks.ablations` trains side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from deepclouds_training.network import Network, NetworkConfig

from benchmarks.ablation_networks import PHASE_COLUMNS, TAU_COLUMNS, Blind, Mirrored, Pooled, Ratio, Shared
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


BASE = "base"
FURNACE_WEIGHT = 0.2
FAST = "small networks"

VARIANTS: tuple[Variant, ...] = (
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
    Variant("symmetric", "inputs", "every block sees the stencil and its mirror image", lambda: Mirrored(_config())),
    Variant("power 0", "loss", "absolute squared error", _plain(), powers=((0.0, 1.0),)),
    Variant("power 1", "loss", "power 1", _plain(), powers=((1.0, 1.0),)),
    Variant("power 2", "loss", "power 2", _plain(), powers=((2.0, 1.0),)),
    Variant("mixture", "loss", "half power 1, half power 2", _plain(), powers=((1.0, 0.5), (2.0, 0.5))),
    Variant("furnace", "loss", f"furnace identity with weight {FURNACE_WEIGHT:g}", _plain(), furnace=FURNACE_WEIGHT),
    Variant("ratio to octaves", "head", "ratio to three octaves", lambda: Ratio(_config(), "octaves")),
    Variant("ratio to diffusion", "head", "ratio to a diffusion estimate", lambda: Ratio(_config(), "diffusion")),
    Variant("width 32", "width", "width 32", _plain(32)),
    Variant("width 128", "width", "width 128", _plain(128)),
    Variant("blocks 20", FAST, "a block a level, width 20", _plain(20)),
    Variant("half the levels", FAST, "levels 0, 2, 4, 6 and 8, width 32", _plain(32, levels=(0, 2, 4, 6, 8))),
    Variant("shared 48", FAST, "one block for all levels, width 48", lambda: Shared(_config(48))),
    Variant("pooled 16", FAST, "16 pooled values a level, then layers of 96", lambda: Pooled(_config(96), 16, blocks=False)),
    Variant("pooled 24", FAST, "24 pooled values a level, then layers of 88", lambda: Pooled(_config(88), 24, blocks=False)),
    Variant("pooled blocks", FAST, "24 pooled values a level, then blocks of 36", lambda: Pooled(_config(36), 24, blocks=True)),
)
