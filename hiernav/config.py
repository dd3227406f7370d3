"""Every setting of training, typed, frozen and checked; one line per setting.

The defaults of a field are those of the preset `default`. Another preset is a set of values that differ from them
(`PRESETS`); a YAML file overrides the preset, and `key.path=value` texts from the command line override the file.
What a trained network depends on is written into its bundle at export: the runtime reads no file of this kind.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from hiernav.decode import ConfigError, FieldHelp, decode, describe, dump_yaml, parse_yaml, unknown_key

__all__ = [
    "ConfigError", "OptionConfig", "PlannerConfig", "RewardConfig", "SkillConfig", "TrainConfig",
    "as_overrides", "check_config", "deciding_settings", "describe_config", "differences", "dump_config",
    "load_config",
]  # fmt: skip

_WORLD_PATTERN = r"^(pillar\([^()]+\)|(gremlin|two-room|four-room)(\([^()]+\))?|map\(.+\)|.+\.ya?ml)$"
_WORLD_HELP = "a world: pillar(2,2,10), gremlin, two-room, four-room, map(file.yaml)"
World = Annotated[str, Meta(pattern=_WORLD_PATTERN, extra={"accepts": _WORLD_HELP})]
_MIX_PATTERN = r"^(\d+(\.\d+)?\s*\*\s*)?" + _WORLD_PATTERN.removeprefix("^")
_MIX_HELP = _WORLD_HELP + "; with ranges and a weight: 2*pillar(2..8,2..8,0.4..0.7/m2)"
MixEntry = Annotated[str, Meta(pattern=_MIX_PATTERN, extra={"accepts": _MIX_HELP})]
Precision = Literal["auto", "float32", "bfloat16"]
Device = Literal["auto", "cpu", "cuda"]
Share = Annotated[float, Meta(ge=0, le=1)]
Width = Annotated[int, Meta(ge=1, le=8192)]


class PlannerConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The waypoint generator: its data set, its network and its training (method sections 4 and 5)."""

    preset: Annotated[Literal["default", "paper"], Meta(description="`paper`: the published network.")] = "default"
    samples: Annotated[int, Meta(ge=1, description="Size of the data set.")] = 60_000
    data: Annotated[
        Annotated[str, Meta(min_length=1)] | None,
        Meta(description="Folder that `hiernav dataset` has made to take them from; null: make them for the run."),
    ] = None
    samples_per_world: Annotated[int, Meta(ge=1, description="Starts labelled by one shortest-path field.")] = 100
    epochs: Annotated[int, Meta(ge=1, description="Passes over the data set.")] = 6
    batch_size: Annotated[int, Meta(ge=1, description="Samples per update.")] = 256
    device: Annotated[Device, Meta(description="Where the network learns; auto: on a GPU where there is one.")] = "auto"
    learning_rate: Annotated[float, Meta(gt=0, le=1, description="Step size of the optimiser.")] = 1e-3
    weight_decay: Annotated[float, Meta(ge=0, le=1, description="Decoupled weight decay of the optimiser.")] = 1e-4
    precision: Annotated[
        Precision, Meta(description="Of products; auto: bfloat16 where the processor multiplies it natively.")
    ] = "auto"
    hypotheses: Annotated[int, Meta(ge=1, le=16, description="Plans proposed at once; the best one learns.")] = 6
    clearance_weight: Annotated[float, Meta(ge=0, description="Weight of the penalty on waypoints near obstacles.")] = (
        1.0
    )
    heading_weight: Annotated[
        float, Meta(ge=0, description="Weight of differences in heading from the labels; makes plans straight.")
    ] = 0.3
    mirror: Annotated[bool, Meta(description="Double the data by reflection left to right.")] = True
    planning_radius_m: Annotated[
        Annotated[float, Meta(gt=0, le=10)] | None,
        Meta(description="Disc that labels keep free [m]; null: the robot's own."),
    ] = None
    soft_margin_m: Annotated[
        float, Meta(ge=0, le=10, description="Further clearance worth a detour in labels [m].")
    ] = 0.15
    worlds: Annotated[
        tuple[MixEntry, ...],
        Meta(min_length=1, description="Worlds the samples are drawn from, each as often as its weight says."),
    ] = (
        "3*pillar(2,2,10)",
        "2*pillar(2..8,2..8,0.4..0.65/m2)",
        "gremlin(2..4,2..4,0.3..0.6/m2)",
        "two-room(2..4,2..4)",
        "four-room(2..4,2..4)",
    )


class SkillConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The low-level skill and its soft actor-critic training (method section 8)."""

    preset: Annotated[
        Literal["default", "paper", "baseline"],
        Meta(
            description="`paper`: as published; `baseline`: no waypoints, the goal instead. "
            "Also the preset of `option` and `reward`."
        ),
    ] = "default"
    worlds: Annotated[tuple[World, ...], Meta(min_length=1, description="Worlds to train in, in equal parts.")] = (
        "pillar(2,2,10)",
    )
    phase_in: Annotated[
        float, Meta(ge=0, le=1, description="Share of training over which the worlds after the first are added.")
    ] = 0.0
    planner: Annotated[
        Literal["astar", "cnn"], Meta(description="Who plans in training: exact search or the trained network.")
    ] = "astar"
    num_envs: Annotated[int, Meta(ge=1, le=65_536, description="Simulations stepped together.")] = 32
    collector: Annotated[
        Literal["local", "multi", "ray"],
        Meta(description="Who simulates: this process, `workers` processes of this machine, or of a Ray cluster."),
    ] = "local"
    workers: Annotated[
        int, Meta(ge=1, le=1024, description="Processes of collector multi or ray, of `num_envs` simulations each.")
    ] = 2
    overlap: Annotated[
        bool, Meta(description="Let workers go on during updates: they act by weights that are one batch older.")
    ] = False
    ray_address: Annotated[
        Annotated[str, Meta(min_length=1)] | None,
        Meta(
            description="Cluster of collector ray; null: $RAY_ADDRESS, one that runs here, or a new one here; "
            "local: a new one here."
        ),
    ] = None
    total_steps: Annotated[int, Meta(ge=1, description="Control steps in all, summed over simulations.")] = 200_000
    learning_starts: Annotated[int, Meta(ge=0, description="Steps with random actions before the first update.")] = (
        2_000
    )
    updates_per_step: Annotated[float, Meta(gt=0, le=64, description="Gradient updates per control step.")] = 0.5
    device: Annotated[Device, Meta(description="Where updates are computed; auto: on a GPU where there is one.")] = (
        "auto"
    )
    batch_size: Annotated[int, Meta(ge=1, description="Transitions per update.")] = 256
    buffer_size: Annotated[int, Meta(ge=1, description="Transitions kept for replay.")] = 1_000_000
    hidden: Annotated[tuple[Width, ...], Meta(min_length=1, description="Widths of the hidden layers.")] = (256, 256)
    discount: Annotated[float, Meta(ge=0, lt=1, description="Discount per control step.")] = 0.98
    tau: Annotated[float, Meta(gt=0, le=1, description="Rate at which target critics follow.")] = 0.005
    learning_rate: Annotated[float, Meta(gt=0, le=1, description="Step size of the optimisers.")] = 3e-4
    actor_average: Annotated[
        int, Meta(ge=0, description="Updates that the evaluated and exported actor is averaged over; 0: the last one.")
    ] = 1_000
    alpha_floor: Annotated[float, Meta(ge=0, description="The temperature does not fall below this.")] = 0.005
    alpha_floor_end: Annotated[
        Annotated[float, Meta(ge=0)] | None,
        Meta(description="Value that the floor falls to during `alpha_fall`; null: it stays."),
    ] = None
    alpha_fall: Annotated[
        tuple[Share, Share], Meta(description="Shares of training between which the floor falls.")
    ] = (0.5, 1.0)
    init_alpha: Annotated[float, Meta(gt=0, description="Temperature at the start.")] = 0.05
    target_entropy: Annotated[
        float | None, Meta(description="Entropy the temperature aims at [nat]; null: -actions.")
    ] = None
    reward_scale: Annotated[float, Meta(gt=0, description="Factor on the reward that the critics learn from.")] = 1.0
    eval_every_steps: Annotated[
        int,
        Meta(
            ge=1,
            description="Steps between evaluations, which come at checkpoints: at the first one at or after that many, "
            "and at the last.",
        ),
    ] = 10_000
    eval_episodes: Annotated[int, Meta(ge=1, description="Episodes per evaluation.")] = 100
    checkpoint_every_steps: Annotated[
        int,
        Meta(
            ge=1,
            description="Steps between checkpoints, at which all episodes begin anew; "
            "about 150 of every simulation where that is more.",
        ),
    ] = 20_000
    stop_reach_rate: Annotated[
        Annotated[float, Meta(gt=0, le=1)] | None,
        Meta(description="Stop once an evaluation reaches this rate; null: never."),
    ] = None
    mirror: Annotated[bool, Meta(description="Reflect half of every batch left to right.")] = True
    end_on_fall: Annotated[bool, Meta(description="End a training episode when the robot has turned over.")] = True
    episode_steps: Annotated[
        Annotated[int, Meta(ge=1)] | None,
        Meta(description="Cap on the steps of a training episode; null: that of its world."),
    ] = None
    clock: Annotated[bool, Meta(description="Show the skill a gait clock of 3 Hz.")] = False
    waypoint_frame: Annotated[
        Literal["body", "world"],
        Meta(description="That the skill observes waypoints in; world: for comparison, `run_loop.py` refuses it."),
    ] = "body"
    precision: Annotated[
        Precision,
        Meta(description="Of products in hidden layers; auto: bfloat16 where the processor multiplies it natively."),
    ] = "auto"
    layer_norm: Annotated[bool, Meta(description="Layer normalisation in the critics.")] = False


class OptionConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a plan ends and what a plan is (method section 6)."""

    d_update_m: Annotated[float, Meta(gt=0, description="Replan farther than this from the closest waypoint [m].")] = (
        0.3
    )
    half_fraction: Annotated[float, Meta(gt=0, le=1, description="Replan once this part of the plan is used up.")] = 0.5
    invalid: Annotated[bool, Meta(description="Replan when the rest of the plan meets the map.")] = True
    period: Annotated[
        Annotated[int, Meta(ge=1)] | None,
        Meta(description="Replan every so many steps instead of by rule; null: by rule."),
    ] = None
    waypoints: Annotated[int, Meta(ge=2, le=100, description="Waypoints of a plan; a skill observes 10.")] = 10
    spacing_m: Annotated[float, Meta(gt=0, le=10, description="Distance between waypoints [m].")] = 0.1


class RewardConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Weights of the named reward terms (method section 7); each is computed in `hiernav.sim.reward`."""

    preset: Annotated[
        Literal["default", "paper", "baseline"],
        Meta(description="How progress is measured; as `skill.preset` if left out."),
    ] = "default"
    path_distance: Annotated[float, Meta(description="Per metre of distance from the plan.")] = -0.1
    progress: Annotated[float, Meta(description="Per `division_m` of progress along the plan.")] = 0.5
    collision: Annotated[float, Meta(description="Per control step with any contact with an obstacle.")] = -1.0
    goal: Annotated[float, Meta(description="Once, on reaching the goal.")] = 1.0
    leave_field: Annotated[float, Meta(description="Once, on leaving the field.")] = -3.0
    tilt: Annotated[
        float, Meta(description="Per unit that the vertical part of the body's axis falls short of 0.8.")
    ] = -3.0
    fall: Annotated[float, Meta(description="Per control step on its back; see skill.end_on_fall.")] = -3.0
    time: Annotated[float, Meta(description="Per control step: below 0, standing still is no way out.")] = 0.0
    goal_distance: Annotated[float, Meta(description="Per metre of distance to the goal, every step.")] = 0.0
    lookahead_m: Annotated[
        float,
        Meta(
            ge=0,
            le=0.5,
            description="How far ahead progress looks [m]: 0 holds a robot to its plan, more lets it explore.",
        ),
    ] = 0.5
    division_m: Annotated[
        float, Meta(gt=0, le=1, description="Spacing of the points that plan and motion are divided in [m].")
    ] = 0.1


class TrainConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One training run."""

    robot: Annotated[Literal["point", "car", "doggo"], Meta(description="Robot to train.")] = "point"
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1, description="The one seed of the run.")] = 0
    run_dir: Annotated[
        Annotated[str, Meta(min_length=1)] | None, Meta(description="Output folder; null: a new one in runs/.")
    ] = None
    threads: Annotated[int, Meta(ge=1, le=1024, description="Threads that step simulations.")] = 1
    planner: PlannerConfig = PlannerConfig()
    skill: SkillConfig = SkillConfig()
    option: OptionConfig = OptionConfig()
    reward: RewardConfig = RewardConfig()


LONGEST_PLAN = 10.0
"""`hiernav.nav.option.LONGEST_PLAN` [m]."""

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "planner": {
        "paper": {
            "weight_decay": 0.0,
            "hypotheses": 1,
            "clearance_weight": 0.0,
            "heading_weight": 0.0,
            "mirror": False,
            "soft_margin_m": 0.0,
            "worlds": ["pillar(2,2,10)"],
        },
    },
    "skill": {
        "paper": {
            "planner": "cnn",
            "num_envs": 1,
            "total_steps": 3_000_000,
            "learning_starts": 10_000,
            "updates_per_step": 1.0,
            "discount": 0.99,
            "init_alpha": 1.0,
            "alpha_floor": 0.0,
            "actor_average": 0,
            "mirror": False,
            "end_on_fall": False,
        },
    },
    "option": {"paper": {"invalid": False}},
    "reward": {
        "paper": {"leave_field": 0.0, "tilt": 0.0, "fall": 0.0},
        # every step costs the distance to the goal, so that an early end has to cost more than all steps it spares
        "baseline": {
            "leave_field": -60.0,
            "fall": -60.0,
            "path_distance": 0.0,
            "progress": 0.0,
            "goal_distance": -1.0,
        },
    },
}
"""Section -> preset -> the values that differ from the field defaults."""

NEUTRAL: dict[str, Any] = {"skill.waypoint_frame": "body"}
"""Settings that came after the first results in `results/`, and the values that say what was done before: with these a
training is still the one it was. A setting that is added belongs in here, else all trainings count as other ones."""


def load_config(path: str | Path | None = None, overrides: list[str] | None = None, begun: bool = False) -> TrainConfig:
    """Read a configuration: preset, then file, then `key.path=value` overrides.

    Args:
        begun: see `check_config`.

    Raises:
        ConfigError: the file cannot be read, or a setting in it cannot be used; see `hiernav.decode`.
    """
    name = "defaults" if path is None else str(path)
    values = {} if path is None else _read(Path(path))
    from_command_line: set[str] = set()
    known = [field.path for field in describe_config()]
    for override in overrides or []:
        key, equals, text = override.partition("=")
        if not equals:
            raise ConfigError(f"command line: {override!r}, expected key.path=value")
        inside = [path for path in known if path.startswith(f"{key}.")]
        if inside:
            raise ConfigError(f"command line: {key!r} is a section: set a key of it, such as {inside[0]!r}")
        if key not in known:
            raise ConfigError(f"command line: {unknown_key(key, known)}")
        section, _, leaf = key.rpartition(".")
        target = values.setdefault(section, {}) if section else values
        if isinstance(target, dict):  # else decode() reports the section
            target[leaf] = parse_yaml(text, f"command line: {key}")
        from_command_line.add(key)

    def source(key: str) -> str:
        return "command line" if key in from_command_line else name

    return check_config(decode(TrainConfig, _apply_presets(values), source), name, begun)


def dump_config(config: TrainConfig) -> str:
    """YAML with every value spelled out; `load_config` reads it back equal, whatever the presets become."""
    return dump_yaml(msgspec.to_builtins(config))


def deciding_settings(config: TrainConfig) -> dict[str, Any]:
    """All settings but those that are `NEUTRAL`, by section, as plain values: what tells one training from another."""
    values = msgspec.to_builtins(config)
    for key, neutral in NEUTRAL.items():
        section, _, name = key.rpartition(".")
        within = values[section] if section else values
        if within[name] == neutral:
            del within[name]
    return values


def differences(config: TrainConfig, reference: TrainConfig | None = None) -> dict[str, Any]:
    """What a configuration sets differently from another, or the defaults: "skill.total_steps" -> 100000."""
    ours, others = msgspec.to_builtins(config), msgspec.to_builtins(reference or TrainConfig())
    found: dict[str, Any] = {}
    for key, value in ours.items():
        if isinstance(value, dict):
            found |= {f"{key}.{k}": v for k, v in value.items() if v != others[key][k]}
        elif value != others[key] and key != "run_dir":
            found[key] = value
    return found


def as_overrides(config: TrainConfig) -> list[str]:
    """What to hand to `load_config` to get this configuration again, but for its `run_dir`."""
    sections: dict[str, Any] = {"planner": config.planner, "skill": config.skill, "reward": config.reward}
    presets = [f"{name}.preset={section.preset}" for name, section in sections.items()]
    if all(preset.endswith("=default") for preset in presets):
        presets = []
    rest = differences(config, load_config(None, presets))
    return presets + [f"{key}={json.dumps(value)}" for key, value in rest.items()]


def describe_config() -> list[FieldHelp]:
    """Every setting with its type, default and description, for `--help`."""
    return describe(TrainConfig)


def check_config(config: TrainConfig, source: str = "configuration", begun: bool = False) -> TrainConfig:
    """Check a configuration that was built in Python, and the rules between settings; returns it.

    Args:
        begun: whether it is that of a run which is there: settings that come to nothing do not keep it from being used.

    Raises:
        ConfigError: names the settings, their values and the limit.
    """
    decode(TrainConfig, msgspec.to_builtins(config), source)
    skill, reward = config.skill, config.reward
    if skill.batch_size > skill.buffer_size:
        raise ConfigError(
            f"{source}: skill.batch_size = {skill.batch_size}, expected <= skill.buffer_size = {skill.buffer_size}"
        )
    if skill.learning_starts >= skill.total_steps:
        raise ConfigError(
            f"{source}: skill.learning_starts = {skill.learning_starts}, "
            f"expected < skill.total_steps = {skill.total_steps}"
        )
    if skill.alpha_fall[0] >= skill.alpha_fall[1]:
        raise ConfigError(f"{source}: skill.alpha_fall = {list(skill.alpha_fall)}, expected an earlier share first")
    if skill.overlap and skill.collector == "local":
        raise ConfigError(f"{source}: skill.overlap = true, expected with skill.collector = 'multi' or 'ray' only")
    if skill.preset != "baseline" and config.option.waypoints != OptionConfig().waypoints:
        raise ConfigError(
            f"{source}: option.waypoints = {config.option.waypoints}, expected {OptionConfig().waypoints}: "
            "that is how many a skill observes"
        )
    reach = config.option.waypoints * config.option.spacing_m
    if reach > LONGEST_PLAN:
        raise ConfigError(
            f"{source}: option.waypoints = {config.option.waypoints} at option.spacing_m = {config.option.spacing_m:g} "
            f"make {reach:g} m, expected at most {LONGEST_PLAN:g} m: longer plans are refused"
        )
    if skill.preset == "baseline" and skill.planner == "cnn":
        raise ConfigError(
            f"{source}: skill.planner = 'cnn', expected 'astar': skill.preset = 'baseline' follows no plan"
        )
    if skill.preset == "baseline" and (reward.path_distance or reward.progress):
        raise ConfigError(
            f"{source}: reward.path_distance = {reward.path_distance} and reward.progress = {reward.progress}, "
            "expected 0: skill.preset = 'baseline' follows no plan"
        )
    if not begun:
        _check_effects(config, source)
    return config


def _check_effects(config: TrainConfig, source: str) -> None:
    planner, skill = config.planner, config.skill
    if skill.batch_size > skill.total_steps:
        raise ConfigError(
            f"{source}: skill.batch_size = {skill.batch_size}, expected <= skill.total_steps = {skill.total_steps}: "
            "there would be no update"
        )
    if skill.alpha_floor == 0 and skill.alpha_floor_end is not None:
        raise ConfigError(
            f"{source}: skill.alpha_floor_end = {skill.alpha_floor_end:g}, expected null with skill.alpha_floor = 0, "
            "which cannot fall"
        )
    if planner.preset == "paper" and planner.hypotheses != 1:
        raise ConfigError(
            f"{source}: planner.hypotheses = {planner.hypotheses}, expected 1 with planner.preset = 'paper', "
            "whose network proposes one plan"
        )


def _read(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text (byte {error.start})") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    values = parse_yaml(text, str(path))
    if not isinstance(values, dict | None):
        raise ConfigError(f"{path}: expected a mapping of settings, got {type(values).__name__}")
    # A section whose lines are all commented out reads as null.
    return {key: {} if value is None and key in PRESETS else value for key, value in (values or {}).items()}


def _apply_presets(values: dict[str, Any]) -> dict[str, Any]:
    """Lay the given values over those of the presets they name. Values of a wrong type are left for `decode`."""

    def preset_of(section: str) -> Any:
        given = values.get(section)
        return given.get("preset") if isinstance(given, dict) else None

    merged = dict(values)
    for section, presets in PRESETS.items():
        own = preset_of(section)
        preset = own if own is not None else preset_of("skill") if section in ("option", "reward") else None
        given = values.get(section, {})
        if not isinstance(preset, str) or not isinstance(given, dict):
            continue
        base = dict(presets.get(preset, {}))
        if section == "reward":
            base["preset"] = preset
        merged[section] = base | given
    return merged
