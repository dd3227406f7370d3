"""Where networks are trained: on the processor or on a GPU, and the random numbers drawn there."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import torch

from hiernav.decode import ConfigError

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of glibc's malloc.h

Result = TypeVar("Result")


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


def choose_precision(name: str, device: torch.device) -> torch.dtype:
    """The type behind a name; "auto" is bfloat16 where a processor multiplies it natively, not on a GPU.

    (A GPU is busy starting kernels at these sizes: the conversions would cost more than the products save.)
    """
    if name == "auto":
        native = torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
        name = "bfloat16" if device.type == "cpu" and native else "float32"
    return {"float32": torch.float32, "bfloat16": torch.bfloat16}[name]


class Recorded(Generic[Result]):
    """A function of one tensor that works in place on a device; on a GPU its kernels are recorded and played back.

    Played back, a hundred small kernels need not be started one by one. The first calls are made as they are: they load
    the kernels and set their memory aside. From the next one on all arguments must be of one shape, nothing outside of
    tensors changes any more, and a result is valid until the next call.
    """

    _CALLS_BEFORE = 3

    def __init__(self, function: Callable[[torch.Tensor], Result], device: torch.device) -> None:
        self._function, self._on_gpu = function, device.type == "cuda"
        self._calls = 0
        self._recording: tuple[torch.cuda.CUDAGraph, torch.Tensor, Result] | None = None

    def __call__(self, argument: torch.Tensor) -> Result:
        if not self._on_gpu or self._calls < self._CALLS_BEFORE:
            self._calls += 1
            return self._function(argument)
        if self._recording is None:
            graph, place = torch.cuda.CUDAGraph(), argument.clone()
            with torch.cuda.graph(graph):
                result = self._function(place)
            self._recording = graph, place, result
        graph, place, result = self._recording
        place.copy_(argument)
        graph.replay()
        return result


def keep_freed_memory() -> None:
    """Let this process keep the memory it frees, where the C library is glibc; elsewhere nothing changes.

    Every layer's output is a few megabytes, which glibc takes from the system and gives back at each update: clearing
    those pages took a third of the training of small convolutions.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_M_MMAP_MAX, 0)
        mallopt(_M_TRIM_THRESHOLD, -1)


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
