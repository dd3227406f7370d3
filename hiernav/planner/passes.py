"""How planners of Table II are trained, and how long whatever the size of their data set; known without torch."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence

import msgspec

from hiernav.config import TrainConfig, deciding_settings, load_config

BATCH, UPDATES, EPOCHS = 256, 1_000, 6
"""Every set is seen six times, and small ones until there were 1,000 updates."""


def epochs(samples: int) -> int:
    """Passes over so many samples."""
    return max(EPOCHS, -(-UPDATES * BATCH // samples))


def updates(samples: int) -> int:
    """Gradient updates in the passes over so many samples."""
    return epochs(samples) * -(-samples // BATCH)


def configuration(
    samples: int, preset: str, seed: int, world: str, robot: str = "point", settings: Sequence[str] = ()
) -> TrainConfig:
    """What an entry of Table II is trained with, its folders apart; `settings` are laid over all others."""
    return load_config(
        None,
        [
            f"robot={robot}",
            f"seed={seed}",
            f"planner.preset={preset}",
            f"planner.samples={samples}",
            f"planner.worlds={json.dumps([world])}",
            f"planner.epochs={epochs(samples)}",
            f"planner.batch_size={BATCH}",
            *settings,
        ],
    )


def what_decides(config: TrainConfig) -> str:
    """All that decides what a planner's training comes to, its seed apart, as JSON."""
    planner = msgspec.structs.replace(config.planner, data=None)
    values = deciding_settings(msgspec.structs.replace(config, planner=planner))
    return msgspec.json.encode({key: values[key] for key in ("robot", "planner", "option")}).decode()


def digest(text: str) -> str:
    """A short hash for the names of folders: what differs lies apart."""
    return hashlib.sha256(text.encode()).hexdigest()[:8]
