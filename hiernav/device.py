"""Where networks are trained: on the processor or on a GPU, and the random numbers drawn there."""

from __future__ import annotations

from typing import Any

import torch

from hiernav.decode import ConfigError


def choose_device(name: str, key: str) -> torch.device:
    """The device behind "cpu", "cuda", or "auto" for a GPU where torch finds one.

    Args:
        name: which.
        key: the setting that says so, for the error.

    Raises:
        ConfigError: a GPU is asked for where there is none.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"{key} = 'cuda', but torch {torch.__version__} finds no GPU here: use auto or cpu")
    return torch.device(name)


def random_state(device: torch.device) -> dict[str, torch.Tensor]:
    """State of the generators that a training on `device` draws from, as a part of its checkpoint."""
    state = {"torch_rng": torch.get_rng_state()}
    if device.type == "cuda":
        state["cuda_rng"] = torch.cuda.get_rng_state(device)
    return state


def restore_random_state(checkpoint: dict[str, Any], device: torch.device) -> None:
    """Go back to the generators of a checkpoint; those of a GPU go on as they are if it was written without one."""
    torch.set_rng_state(checkpoint["torch_rng"])
    if device.type == "cuda" and "cuda_rng" in checkpoint:
        torch.cuda.set_rng_state(checkpoint["cuda_rng"], device)
