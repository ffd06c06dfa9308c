"""Where an image still needs samples: an estimate of its noise, and blocks of pixels that rest once they add little to it."""

from __future__ import annotations

import math

import numpy as np

from deepclouds_runtime.result import Image

# Values below this share of the brightest do not count in the noise.
DARK = 0.02
# Side of the blocks of pixels that rest together, and the share of the noise asked for that resting blocks may have.
_BLOCK, _REST = 8, 0.5
# The variance of well spread samples falls a little faster than with their number: the power of the number that it asks for.
_CONVERGENCE = 0.75


class Adaptive:
    """The pixels that still take samples.

    Parameters
    ----------
    size
        (width, height), pixels.

    Attributes
    ----------
    active
        numbers of these pixels.
    dazzled
        (pixels,) which ones look into a sun's disc: so bright, they would be all that counts in the noise.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        pixels = size[0] * size[1]
        self.active = np.arange(pixels, dtype=np.uint32)
        self.dazzled = np.zeros(pixels, bool)
        # Estimated variance of the mean of each pixel.
        self._variance = np.zeros((pixels, 3), np.float64)
        # Of the means of rounds: how many there were after the first, and their sum of squared deviations, weighted by samples.
        self._rounds, self._scatter = 0, np.zeros((pixels, 3), np.float64)

    def settle(self, before: Image, after: Image, done: int, samples: int, error: float, rest: bool = True) -> tuple[float, float]:
        """Estimate the noise, and let blocks of pixels rest that add little to it.

        Parameters
        ----------
        before, after
            the image (pixels, 3) before and after the last round.
        done, samples
            how many samples its active pixels had taken before and after.
        error
            noise to aim at, over the mean.
        rest
            whether blocks may rest.

        Returns
        -------
        The noise of the whole image over the mean, and by how much the number of samples of the remaining pixels should grow.
        """
        width, height = self._size
        after, active = np.where(self.dazzled[:, None], 0, after), self.active
        # Of a mean of which the last part is independent of the first.
        change = np.square((after[active] - before[active]).astype(np.float64))
        if rest:
            self._variance[active] = change * (done / (samples - done))
        else:
            # Where all pixels have the same rounds, each round tells as much as any other.
            self._rounds += 1
            self._scatter += change * (done / (samples - done) * samples)
            self._variance = self._scatter / (self._rounds * samples)
        lit = after > DARK * np.quantile(after, 0.999)
        if not lit.any():
            return 0.0, 1.0
        allowed = (error * float(after[lit].mean(dtype=np.float64))) ** 2 * np.count_nonzero(lit)
        noise = error * math.sqrt(float(self._variance[lit].sum()) / allowed) if allowed > 0 else 0.0
        if not rest:
            return noise, float(np.clip((noise / error) ** 2, 1.0 + 0.5 / samples, 4.0))
        # A pixel's own estimate has two numbers behind it, a block's has many.
        index = np.arange(width * height)
        columns = -(-width // _BLOCK)
        block = index // width // _BLOCK * columns + index % width // _BLOCK
        of_block = np.bincount(block, np.where(lit, self._variance, 0).sum(axis=1))
        awake = np.zeros(len(of_block), bool)
        awake[block[active]] = True
        resting = float(of_block[~awake].sum())
        order = np.flatnonzero(awake)[np.argsort(of_block[awake])]
        sleepy = order[resting + np.cumsum(of_block[order]) <= _REST * allowed]
        # What never stays awake cannot bring the noise down.
        if len(sleepy) < len(order):
            awake[sleepy] = False
            resting += float(of_block[sleepy].sum())
            self.active = active[awake[block[active]]]
        moving = float(of_block[awake].sum())
        growth = (moving / max(allowed - resting, 1e-30)) ** _CONVERGENCE
        return noise, float(np.clip(growth, 1.0 + 0.5 / samples, 4.0))
