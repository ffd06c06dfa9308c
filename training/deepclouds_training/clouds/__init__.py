"""Procedural cloud families: seeded functions of a few named parameters, each returning a `Volume`."""

from deepclouds_training.clouds._make import (
    COARSEST,
    FAMILIES,
    HELD_OUT,
    SUPPLEMENT,
    TRAINING,
    Family,
    draw_parameters,
    find_family,
    make_cloud,
)
from deepclouds_training.clouds._parameters import Choice, CloudParameters, Range
from deepclouds_training.clouds._raster import weighted_mean
from deepclouds_training.clouds.scene import scale_for_optical_depth, write_mitsuba_scene

__all__ = [
    "COARSEST",
    "FAMILIES",
    "HELD_OUT",
    "SUPPLEMENT",
    "TRAINING",
    "Choice",
    "CloudParameters",
    "Family",
    "Range",
    "draw_parameters",
    "find_family",
    "make_cloud",
    "scale_for_optical_depth",
    "weighted_mean",
    "write_mitsuba_scene",
]
