"""Early stop: how many validations in a row brought nothing better."""

from __future__ import annotations

import math
from collections.abc import Mapping


class Patience:
    """Counts validations since the last best figure.

    A validation is better when it has the smallest rRMSE so far (before it is kept from going negative) or the smallest absolute
    energy: a run whose error rests may still lose a bias.

    Parameters
    ----------
    limit
        validations in a row without a best that end a run; None never does.
    """

    def __init__(self, limit: int | None) -> None:
        self._limit = limit
        self._best = {"squared": math.inf, "energy": math.inf}
        self._since = 0

    @property
    def exhausted(self) -> bool:
        """Whether it is time to stop."""
        return self._limit is not None and self._since >= self._limit

    def take(self, figures: Mapping[str, float]) -> None:
        """Take in one validation's `deepclouds_training.validation.Figures`, by name."""
        found = {"squared": figures["squared"], "energy": abs(figures["energy"])}
        self._since += 1
        for name, value in found.items():
            if value < self._best[name]:
                self._best[name] = value
                self._since = 0

    def state_dict(self) -> dict[str, float]:
        """What `load_state_dict` restores."""
        return {**self._best, "since": self._since}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Restore `state_dict`."""
        self._best = {name: state[name] for name in self._best}
        self._since = int(state["since"])
