"""What a data set of labels is made of."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from deepclouds_training.clouds import COARSEST, FAMILIES, HELD_OUT, TRAINING
from deepclouds_training.config_file import config_hash, read_toml, validated
from deepclouds_training.labels import GROUP

Share = Annotated[float, Field(ge=0, le=1)]


class GenerateConfig(BaseModel):
    """What a data set is made of; unknown keys are errors. docs/dataset.md says why the shares are what they are.

    Attributes
    ----------
    seed
        root of every random stream.
    train_shards, valid_shards
        number of clouds from the training and from the held-out families.
    points, suns
        points a cloud, suns a point.
    walks
        least and most walks a point, multiples of 8; every walk serves all suns and albedos.
    target
        relative standard error sought for a label, or a tenth of it relative to the cloud's mean label where that is larger.
    meet
        whether a point's labels are to meet the target in the mean or every one of them.
    pilot
        walks a point that only decide how many follow, a multiple of 8; none are traced where least and most walks are the same.
    slow_size
        beyond this size of a cloud, in mean free paths, the most walks fall with its inverse: walks there are long.
    connect
        see `deepclouds.medium.multiple_scattering.trace_walks`.
    families, held_out
        names of cloud families; the two must not overlap.
    family_weights
        relative frequency of families, 1 where not given.
    resolution, coarse_resolution, coarse
        least and largest number of samples along the longest axis, log-uniform, and the same for the share `coarse` of clouds.
    size
        least and largest length of the longest side in units of length (mean free paths at the mean extinction), log-uniform.
    voxel_depth
        most optical depth a voxel at the mean extinction; it bounds the size from above.
    second, beside, inside, anywhere
        shares of the points that are no first collisions: see `deepclouds_training.points.sample_points`.
    volpath_every
        one cloud in so many has points that share two suns, phase functions and albedos, so that ``--tracer mitsuba`` can label the
        same points; 0 for none.
    volpath_walks
        share of a point's walks that volpath is given for each of its labels, in clouds of up to 40 mean free paths; beyond, it falls
        with the inverse square of the size. Its walks serve one label each, and are slower.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    seed: Annotated[int, Field(ge=0)] = 1
    train_shards: Annotated[int, Field(ge=0)] = 8
    valid_shards: Annotated[int, Field(ge=0)] = 2
    points: Annotated[int, Field(ge=1, le=2**20)] = 8192
    suns: Annotated[int, Field(ge=1, le=16)] = 4
    walks: tuple[int, int] = (8, 128)
    target: Annotated[float, Field(gt=0)] = 0.5
    meet: Literal["mean", "every"] = "mean"
    pilot: Annotated[int, Field(ge=GROUP, multiple_of=GROUP)] = 8
    slow_size: Annotated[float, Field(gt=0)] = 200.0
    connect: Annotated[float, Field(gt=0)] = 0.25
    families: tuple[str, ...] = TRAINING
    held_out: tuple[str, ...] = HELD_OUT
    family_weights: dict[str, Annotated[float, Field(gt=0)]] = {}
    resolution: tuple[int, int] = (32, 384)
    coarse_resolution: tuple[int, int] = (8, 32)
    coarse: Share = 0.15
    size: tuple[float, float] = (1.0, 2000.0)
    voxel_depth: Annotated[float, Field(gt=0)] = 10.0
    second: Share = 0.13
    beside: Share = 0.3
    inside: Share = 0.06
    anywhere: Share = 0.06
    volpath_every: Annotated[int, Field(ge=0)] = 0
    volpath_walks: Annotated[float, Field(gt=0, le=1)] = 1.0

    @model_validator(mode="after")
    def _consistent(self) -> GenerateConfig:
        unknown = [f for f in (*self.families, *self.held_out, *self.family_weights) if f not in FAMILIES]
        if unknown:
            raise ValueError(f"unknown cloud families {unknown}; there are: {', '.join(FAMILIES)}")
        both = set(self.families) & set(self.held_out)
        if both:
            raise ValueError(f"families {sorted(both)} are both trained on and held out")
        for name in ("resolution", "coarse_resolution"):
            low, high = getattr(self, name)
            if not COARSEST <= low <= high:
                raise ValueError(f"{name} {(low, high)} must be an increasing pair of at least {COARSEST}")
        if not 0 < self.size[0] <= self.size[1]:
            raise ValueError(f"size {self.size} must be an increasing pair above 0")
        if not 0 < self.walks[0] <= self.walks[1] or self.walks[0] % GROUP or self.walks[1] % GROUP:
            raise ValueError(f"walks {self.walks} must be an increasing pair of multiples of {GROUP}")
        if self.second + self.beside + self.inside + self.anywhere > 1:
            raise ValueError("second, beside, inside and anywhere are shares of the points: their sum must not exceed 1")
        if (self.train_shards and not self.families) or (self.valid_shards and not self.held_out):
            raise ValueError("shards are asked for from an empty list of families")
        return self

    def hash(self) -> str:
        """SHA-256 of the resolved configuration."""
        return config_hash(self)


def load_config(path: Path) -> GenerateConfig:
    """Read a TOML file into a `GenerateConfig`; InputError when it is missing, malformed or holds unknown keys."""
    return validated(GenerateConfig, read_toml(path), str(path))
