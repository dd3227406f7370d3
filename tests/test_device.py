"""Networks are trained where the configuration says; a GPU is taken where there is one and never pretended."""

from __future__ import annotations

from pathlib import Path

import pytest
import tiny_run

torch = pytest.importorskip("torch", reason="needs the extra hiernav[train]")

from hiernav import cli  # noqa: E402
from hiernav.commands import exits  # noqa: E402
from hiernav.decode import ConfigError  # noqa: E402
from hiernav.device import choose_device, random_state, restore_random_state  # noqa: E402

pytestmark = pytest.mark.train


@pytest.fixture
def gpu(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether torch says that it finds a GPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: request.param)
    return request.param


@pytest.mark.parametrize(("gpu", "chosen"), [(True, "cuda"), (False, "cpu")], indirect=["gpu"])
def test_auto_is_a_gpu_where_there_is_one(gpu: bool, chosen: str) -> None:
    assert choose_device("auto", "skill.device").type == chosen


@pytest.mark.parametrize("gpu", [True, False], indirect=True)
def test_the_processor_can_always_be_asked_for(gpu: bool) -> None:
    assert choose_device("cpu", "skill.device").type == "cpu"


@pytest.mark.parametrize("gpu", [False], indirect=True)
def test_a_gpu_that_is_not_there_is_refused_by_the_name_of_the_setting(gpu: bool) -> None:
    with pytest.raises(ConfigError, match=r"planner\.device = 'cuda'.*finds no GPU"):
        choose_device("cuda", "planner.device")


@pytest.mark.parametrize("gpu", [False], indirect=True)
@pytest.mark.parametrize("key", ["planner.device", "skill.device"])
def test_a_gpu_that_is_not_there_is_refused_before_a_run_folder_is_made(
    gpu: bool, key: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    assert cli.main(["train", *tiny_run.arguments(folder, f"{key}=cuda")]) == exits.BAD_INPUT
    assert key in capsys.readouterr().err and not folder.exists()


def test_restored_generators_draw_the_same_again() -> None:
    torch.manual_seed(5)
    state = random_state(torch.device("cpu"))
    drawn = torch.rand(4)
    restore_random_state(state, torch.device("cpu"))
    assert torch.equal(torch.rand(4), drawn)
