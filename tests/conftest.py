"""Settings of all tests: reproducible examples in CI, one thread for torch."""

from __future__ import annotations

import importlib.util
import os

import pytest
from hypothesis import settings

# No deadline anywhere: a claim about the robot does not depend on how busy the machine is.
settings.register_profile("ci", derandomize=True, deadline=None, print_blob=True)
settings.register_profile("dev", deadline=None)
settings.load_profile("ci" if os.environ.get("CI") else "dev")

HAS_TRAIN = all(importlib.util.find_spec(name) for name in ("torch", "torchrl", "tensordict"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if not HAS_TRAIN:
        skip = pytest.mark.skip(reason="needs the extra hiernav[train]")
        for item in items:
            if item.get_closest_marker("train"):
                item.add_marker(skip)


@pytest.fixture(scope="session", autouse=True)
def one_torch_thread(request: pytest.FixtureRequest) -> None:
    if HAS_TRAIN and any(item.get_closest_marker("train") for item in request.session.items):
        import torch

        torch.set_num_threads(1)
