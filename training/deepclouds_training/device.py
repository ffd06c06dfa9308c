"""Where the network is trained, a GPU where there is one, else the processor, and what that computes fast."""

from __future__ import annotations

import torch

from deepclouds.errors import InputError


def chosen_device(name: str, local_rank: int = 0) -> torch.device:
    """The device called ``auto``, ``cpu`` or ``cuda``; processes of one machine take its GPUs in turn.

    Raises
    ------
    InputError
        for ``cuda`` where torch finds no CUDA device.
    """
    found = torch.cuda.is_available()
    if name == "cuda" and not found:
        raise InputError("device = 'cuda': torch finds no CUDA device; install a CUDA build of torch, or set device = 'auto'")
    return torch.device("cuda", local_rank % torch.cuda.device_count()) if found and name != "cpu" else torch.device("cpu")


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether a device has products in bfloat16; where they are emulated, a training step takes tens of times as long."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return any(getattr(torch.cpu, name, lambda: False)() for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported"))
