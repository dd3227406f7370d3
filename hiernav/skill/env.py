"""TorchRL environment over the navigation task: one batched env in process, glue only."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from hiernav.nav.termination import TerminationReason
from hiernav.sim.factory import RandomLayouts
from hiernav.sim.reward import TERMS
from hiernav.sim.task import NavigationTask


class PhysicsDiverged(RuntimeError):
    """The physics of a simulation is no longer finite; says which episode it was."""


class NavigationEnv(EnvBase):
    """N robots following plans; batch size (N,).

    Beside `observation`, `reward`, `done`, `terminated` and `truncated` a step holds, for logging: `terms`
    (N, len(TERMS)) unweighted reward terms in the order of `TERMS`, `reason` (N, 1) why the option ended, `reached`
    and `collided` (N, 1), and `episode_steps` (N, 1).

    A step raises `PhysicsDiverged` if a simulation's physics is no longer finite afterwards: nothing is to be learnt
    from a broken robot.

    `set_seed` decides the worlds of all episodes that follow, as `seed` of a configuration does, and nothing else is
    random: environments of one configuration, such as the workers of a `ParallelEnv`, drive in the same worlds until
    they are seeded. A task that was made with layouts of one's own keeps these. Closing the environment closes the
    task's simulations.
    """

    def __init__(self, task: NavigationTask) -> None:
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([task.num_rows]))
        self.task = task
        n, size, actions = task.num_rows, task.layout.size, task.robot.action_dim
        flag = {"n": 1, "shape": (n, 1), "dtype": torch.bool}
        self.observation_spec = Composite(
            observation=Unbounded((n, size), dtype=torch.float32),
            terms=Unbounded((n, len(TERMS)), dtype=torch.float32),
            reason=Bounded(0, len(TerminationReason) - 1, (n, 1), dtype=torch.int8),
            reached=Binary(**flag),
            collided=Binary(**flag),
            episode_steps=Unbounded((n, 1), dtype=torch.int64),
            shape=(n,),
        )
        self.action_spec = Bounded(-1.0, 1.0, (n, actions), dtype=torch.float32)
        self.reward_spec = Unbounded((n, 1), dtype=torch.float32)
        self.done_spec = Composite(done=Binary(**flag), terminated=Binary(**flag), truncated=Binary(**flag), shape=(n,))

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        rows = None
        if tensordict is not None and "_reset" in tensordict.keys():
            rows = np.flatnonzero(tensordict["_reset"].reshape(-1).cpu().numpy())
        observation = self.task.reset(rows)
        false = torch.zeros((*self.batch_size, 1), dtype=torch.bool)
        return TensorDict(
            {
                "observation": torch.from_numpy(observation),
                "terms": torch.zeros((*self.batch_size, len(TERMS))),
                "reason": torch.full((*self.batch_size, 1), int(TerminationReason.START), dtype=torch.int8),
                "reached": false,
                "collided": false.clone(),
                "episode_steps": torch.from_numpy(self.task.steps.copy())[:, None],
                "done": false.clone(),
                "terminated": false.clone(),
                "truncated": false.clone(),
            },
            self.batch_size,
            device=self.device,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        step = self.task.step(tensordict["action"].detach().cpu().numpy())
        if step.broken.any():
            raise PhysicsDiverged(self._broken_episode(int(np.flatnonzero(step.broken)[0])))

        def column(values: np.ndarray, dtype: torch.dtype) -> torch.Tensor:
            return torch.as_tensor(values, dtype=dtype).unsqueeze(-1)

        return TensorDict(
            {
                "observation": torch.from_numpy(step.observation),
                "terms": torch.from_numpy(np.stack([step.terms[k] for k in TERMS], axis=-1).astype(np.float32)),
                "reason": column(step.option.reason, torch.int8),
                "reached": column(step.reached, torch.bool),
                "collided": column(step.collided, torch.bool),
                "episode_steps": column(self.task.steps.copy(), torch.int64),
                "reward": column(step.reward, torch.float32),
                "done": column(step.terminated | step.truncated, torch.bool),
                "terminated": column(step.terminated, torch.bool),
                "truncated": column(step.truncated, torch.bool),
            },
            self.batch_size,
            device=self.device,
        )

    def _broken_episode(self, row: int) -> str:
        layout, radius = self.task.layouts[row], self.task.robot.radius
        return (
            f"the physics of simulation {row} is not finite after step {self.task.steps[row]} of an episode in world "
            f"{layout.spec}, seed {layout.seed} (see it with: hiernav world --kind '{layout.spec}' "
            f"--seed {layout.seed} --radius {radius:g} --png world.png)"
        )

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None and isinstance(self.task.layout_source, RandomLayouts):
            self.task.draw_from(self.task.layout_source.of_seed(seed))

    def close(self, *, raise_if_closed: bool = True) -> None:
        super().close(raise_if_closed=raise_if_closed)
        self.task.sim.close()
