"""Features of angle, phase function, albedo and optical depth, and an analytic estimate of j that is made of them."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

ORDERS = (1, 2, 4, 8)
FEATURES = 6 + len(ORDERS) + 3
# Columns of the features: the first of log(4 pi p_n) / 4, and log(1 + tau) / 4.
LOG_PHASE, LOG1P_TAU = 2, 10
TAU_LIMIT = 1e6
G_LIMIT = 0.999


class AngleFeatures(nn.Module):
    """Features of angle, phase function, albedo and optical depth, each of order 1, from the contract's ``aux`` rows.

    Light that has scattered n times in a forward peak still follows the n-fold convolution of the phase function: for one
    Henyey-Greenstein lobe that is the lobe with g^n, for two lobes a binomial mixture of lobes with g1^i g2^(n - i). Their logarithms at
    gamma resolve a peak that the raw angle cannot.
    """

    chosen: Tensor
    binomials: Tensor
    groups: Tensor

    def __init__(self) -> None:
        super().__init__()
        terms = [(n, i) for n in ORDERS for i in range(n + 1)]
        # Columns of `_powers` of g1, g2 and both weights: g1^i g2^(n - i), and the same of the weights.
        exponents = [[i for _, i in terms], [n - i for n, i in terms]] * 2
        self.register_buffer("chosen", torch.tensor([4 * e + k for k, row in enumerate(exponents) for e in row]), persistent=False)
        self.register_buffer("binomials", torch.tensor([float(math.comb(n, i)) for n, i in terms]), persistent=False)
        groups = torch.tensor([[float(n == order) for order in ORDERS] for n, _ in terms])
        self.register_buffer("groups", groups, persistent=False)

    def forward(self, aux: Tensor) -> Tensor:
        """Features (n, `FEATURES`) of rows (n, 6); inputs beyond their physical range are clamped."""
        gamma, g1, g2, weight, albedo, log1p_tau = torch.split(aux, 1, dim=1)
        gamma = torch.clamp(gamma, 0.0, math.pi)
        g1, g2 = torch.clamp(g1, -G_LIMIT, G_LIMIT), torch.clamp(g2, -G_LIMIT, G_LIMIT)
        weight, albedo = torch.clamp(weight, 0.0, 1.0), torch.clamp(albedo, 0.0, 1.0)
        log1p_tau = torch.clamp(log1p_tau, 0.0, math.log1p(TAU_LIMIT))
        tau = torch.exp(log1p_tau) - 1.0

        log_phase = torch.log(self.phase_of_orders(gamma, g1, g2, weight))
        mean_g = weight * g1 + (1.0 - weight) * g2
        # Diffusion sees albedo and g only as this ratio (van de Hulst 1980, section 14.1) and as the reduced optical depth.
        similarity = torch.sqrt((1.0 - albedo) / torch.clamp(1.0 - albedo * mean_g, min=1e-3))
        reduced = torch.log(1.0 + tau * (1.0 - mean_g))
        scaled = [gamma / math.pi, torch.cos(gamma), 0.25 * log_phase, g1, g2, weight]
        return torch.cat([*scaled, similarity, 0.25 * log1p_tau, 0.25 * reduced, torch.exp(-tau)], dim=1)

    def phase_of_orders(self, gamma: Tensor, g1: Tensor, g2: Tensor, weight: Tensor) -> Tensor:
        """``4 pi p`` at `gamma` after 1, 2, 4 and 8 scatterings: columns (n, 1) to (n, 4)."""
        # All powers together, in as few operations as there are: a small network spends much of its time in their number.
        powers = _powers(torch.cat([g1, g2, weight, 1.0 - weight], dim=1))
        g1_i, g2_i, weight_i, rest_i = torch.split(torch.index_select(powers, 1, self.chosen), len(self.binomials), dim=1)
        product, mixture = g1_i * g2_i, weight_i * rest_i * self.binomials
        a = torch.abs(product)
        # (1 - |g|)^2 + 4 |g| sin^2 keeps its digits where 1 + g^2 - 2 g cos cancels, and half angles resolve the peak itself.
        ahead, behind = torch.sin(0.5 * gamma), torch.cos(0.5 * gamma)
        half = torch.where(product < 0.0, behind, ahead)
        denominator = (1.0 - a) * (1.0 - a) + 4.0 * a * half * half
        value = (1.0 - a) * (1.0 + a) / (denominator * torch.sqrt(denominator))
        return torch.matmul(mixture * value, self.groups)


def log_octaves(f: Tensor) -> Tensor:
    """Logarithm (n, 1) of an analytic estimate of j from features (n, `FEATURES`).

    E = 0.02 + sum over i = 1, 2, 3 of 0.5^i exp(-0.5^i tau) 4 pi p_(2^i)(gamma), where p_n is the phase function after n scatterings:
    the octaves of Wrenninge et al. 2013, "Oz: The Great and Volumetric" (a = b = 0.5), without the first, because j counts multiple
    scattering alone, and with exact convolutions in the place of their scaled g. The constant stands for light that has lost all
    memory of its direction.
    """
    tau = torch.exp(4.0 * f[:, LOG1P_TAU : LOG1P_TAU + 1]) - 1.0
    share = torch.tensor([[0.5, 0.25, 0.125]], dtype=f.dtype, device=f.device)
    terms = share * torch.exp(4.0 * f[:, LOG_PHASE + 1 : LOG_PHASE + 4] - share * tau)
    return torch.log(terms.sum(dim=1, keepdim=True) + 0.02)


def _powers(values: Tensor) -> Tensor:
    """Powers 0 to 8 of (n, k), (n, 9 k); products, because a power function of zero or of negative numbers is not portable."""
    powers = [torch.ones_like(values)]
    for _ in range(max(ORDERS)):
        powers.append(powers[-1] * values)
    return torch.cat(powers, dim=1)
