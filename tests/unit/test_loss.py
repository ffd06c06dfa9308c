"""The loss finds the mean of noisy, skewed labels; a loss on logarithms does not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from deepclouds_training.loss import FLOOR, relative_squared_error

TRUTH = (0.05, 3.0)


def noisy_labels(count: int = 40_000) -> torch.Tensor:
    """Rows of log-normal labels with means `TRUTH` and a relative standard deviation of 2; (2, count)."""
    sigma = np.sqrt(np.log(1 + 2.0**2))
    noise = np.random.default_rng(5).lognormal(-(sigma**2) / 2, sigma, (2, count))
    return torch.from_numpy(np.array(TRUTH)[:, None] * noise)


def fitted(labels: torch.Tensor, loss: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> torch.Tensor:
    """A model with one free value for each row, fitted by Adam to all labels at once."""
    parameter = torch.zeros(len(labels), 1, dtype=torch.float64, requires_grad=True)
    # The rows' gradients shrink by orders of magnitude on the way: a short memory keeps Adam's steps in proportion.
    optimiser = torch.optim.Adam([parameter], lr=0.1, betas=(0.8, 0.9), eps=1e-12)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 300)
    for _ in range(300):
        optimiser.zero_grad()
        loss(torch.exp(parameter).expand_as(labels), labels).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
    return torch.exp(parameter.detach()).squeeze(1)


@pytest.mark.parametrize("power", [0.0, 1.0, 1.5, 2.0])
def test_minimiser_is_the_mean(power: float) -> None:
    labels = noisy_labels()
    found = fitted(labels, lambda p, y: relative_squared_error(p, y, power))
    np.testing.assert_allclose(found, labels.mean(dim=1), rtol=2e-3)
    np.testing.assert_allclose(found, TRUTH, rtol=0.03)


def test_a_loss_on_logarithms_loses_energy() -> None:
    found = fitted(noisy_labels(), lambda p, y: torch.mean(torch.square(torch.log(p) - torch.log(y))))
    # The median of a log-normal with relative deviation 2 is 1 / sqrt(5) of its mean.
    np.testing.assert_allclose(found, np.array(TRUTH) / np.sqrt(5), rtol=0.03)


def test_no_gradient_flows_through_the_weight() -> None:
    prediction = torch.tensor([0.2, 1.0, 4.0], requires_grad=True)
    label = torch.tensor([1.0, 0.5, 4.5])
    relative_squared_error(prediction, label, 1.5).backward()  # type: ignore[no-untyped-call]
    p = prediction.detach()
    torch.testing.assert_close(prediction.grad, 2 * (p - label) / (p + FLOOR) ** 1.5 / 3)
