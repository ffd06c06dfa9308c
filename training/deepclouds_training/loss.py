"""The loss: relative squared error that stays unbiased when the labels are noisy."""

from __future__ import annotations

import torch
from torch import Tensor

FLOOR = 0.05


def relative_squared_error(prediction: Tensor, label: Tensor, power: float = 1.5) -> Tensor:
    """Mean of ``(p - y)^2 / stopgrad(p + 0.05)^power``.

    A Monte Carlo label is y = truth + noise of mean zero, skewed, and about as large as the truth itself. The gradient is linear in y and
    its weight does not depend on y, so its expectation over the noise is that of the noise-free label: noisy labels train toward their
    mean. A loss on log y would train toward the mean of the logarithm, which lies below the logarithm of the mean (Jensen), and the
    energy would be lost; a weight made of y would favour the labels that happen to be small. For the same reason neither labels nor
    gradients may be clipped.

    The noise's variance grows as the square of the truth: `power` 2 would weight every sample by the inverse of its variance, 0 would
    leave the fit to the brightest samples. The floor keeps samples that are dark in every respect from taking over.

    Parameters
    ----------
    prediction
        (n,), positive; the weight is made of it, without a gradient.
    label
        (n,), unbiased.
    power
        exponent of the weight.

    Returns
    -------
    scalar tensor.

    Notes
    -----
    Lehtinen et al. 2018, "Noise2Noise" (section 3, the relative loss for high dynamic range).
    """
    weight = torch.pow(prediction.detach() + FLOOR, -power)
    return torch.mean(torch.square(prediction - label) * weight)
