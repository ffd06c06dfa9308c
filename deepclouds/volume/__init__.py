"""A density field, its files, and its filtered pyramid."""

from deepclouds.volume._volume import Volume

__all__ = ["Volume"]
