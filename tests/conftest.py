"""Settings of all tests: reproducible examples in CI, one thread for torch."""

from __future__ import annotations

import importlib.util
import os
import shutil
from pathlib import Path

import pytest
import tiny_run
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


@pytest.fixture(scope="session")
def trained_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run folder that `hiernav train` has left: all of it in miniature."""
    from hiernav import cli
    from hiernav.planner import train

    folder = tmp_path_factory.mktemp("trained") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "_WALKS", 3)
        assert cli.main(["train", *tiny_run.arguments(folder)]) == 0
    return folder


@pytest.fixture(scope="session")
def able_run(trained_run: Path) -> Path:
    """`trained_run` with a skill that arrives in the place of the one that has hardly learnt anything."""
    from steering import steering_actor

    from hiernav.run import Run

    folder = trained_run.with_name("able")
    shutil.copytree(trained_run, folder)
    run = Run.open(folder)
    run.save("skill", {**run.load("skill"), "best_actor": steering_actor(run.config).state_dict()})
    return folder


@pytest.fixture(scope="session")
def able_bundle(able_run: Path) -> Path:
    """The bundle exported from `able_run`. Copy it before changing anything in it."""
    from hiernav import cli

    folder = able_run.with_name("bundle")
    assert cli.main(["export", "--run", str(able_run), "--onnx", str(folder)]) == 0
    return folder


@pytest.fixture(scope="session")
def doggo_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle with the paper's networks for the doggo, untrained. Copy it before changing anything in it."""
    import torch

    from hiernav.export import write_bundle
    from hiernav.planner.network import make_network
    from hiernav.skill.train import make_learner

    folder = tmp_path_factory.mktemp("doggo")
    config = tiny_run.config(folder, "robot=doggo", "planner.preset=paper", "planner.hypotheses=1")
    torch.manual_seed(0)
    write_bundle(folder, config, make_network("paper", 10, 0.1, 1), make_learner(config).actor, {})
    return folder
