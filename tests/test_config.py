"""Claims about settings: what is accepted is what is written, and what is wrong is named."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiernav.config import (
    LONGEST_PLAN,
    PRESETS,
    ConfigError,
    OptionConfig,
    PlannerConfig,
    RewardConfig,
    SkillConfig,
    TrainConfig,
    as_overrides,
    check_config,
    describe_config,
    dump_config,
    load_config,
)
from hiernav.nav import option
from hiernav.sim import layout
from hiernav.sim.robots import get_robot

CONFIGS = sorted((Path(__file__).parents[1] / "configs").glob("*.yaml"))
SECTIONS = {"planner": PlannerConfig, "skill": SkillConfig, "option": OptionConfig, "reward": RewardConfig}


def write(folder: Path, text: str) -> Path:
    path = folder / "robot.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def error_of(path: Path | None, *overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(path, list(overrides))
    message = str(caught.value)
    assert "\n" not in message
    return message


def load_text(folder: Path, text: str) -> TrainConfig:
    return load_config(write(folder, text))


def test_without_a_file_every_setting_is_the_default() -> None:
    assert load_config() == TrainConfig()


def test_the_command_line_overrides_the_file_and_the_file_overrides_the_preset(tmp_path: Path) -> None:
    path = write(tmp_path, "skill: {preset: paper, num_envs: 4, tau: 0.01}\n")
    skill = load_config(path, ["skill.tau=0.02", "robot=doggo"]).skill
    assert (skill.alpha_floor, skill.num_envs, skill.tau) == (0.0, 4, 0.02)
    assert load_config(path, ["robot=doggo"]).robot == "doggo"


def test_a_preset_can_be_chosen_on_the_command_line(tmp_path: Path) -> None:
    path = write(tmp_path, "planner: {epochs: 3}\n")
    planner = load_config(path, ["planner.preset=paper"]).planner
    assert (planner.hypotheses, planner.mirror, planner.epochs) == (1, False, 3)


def test_option_and_reward_follow_the_preset_of_the_skill() -> None:
    paper = load_config(overrides=["skill.preset=paper"])
    assert not paper.option.invalid
    assert paper.reward.preset == "paper"
    baseline = load_config(overrides=["skill.preset=baseline"])
    assert baseline.reward == RewardConfig(
        preset="baseline", path_distance=0.0, progress=0.0, leave_field=-60.0, fall=-60.0, goal_distance=-1.0
    )
    assert load_config(overrides=["skill.preset=paper", "reward.preset=default"]).reward == RewardConfig()


def test_the_paper_preset_has_the_published_values() -> None:
    config = load_config(overrides=["skill.preset=paper", "planner.preset=paper"])
    skill, reward, option = config.skill, config.reward, config.option
    assert skill.hidden == (256, 256)
    assert (skill.learning_rate, skill.discount, skill.tau) == (3e-4, 0.99, 0.005)
    assert (skill.buffer_size, skill.batch_size, skill.updates_per_step) == (1_000_000, 256, 1.0)
    assert (reward.path_distance, reward.progress, reward.collision, reward.goal) == (-0.1, 0.5, -1.0, 1.0)
    assert (option.d_update_m, option.half_fraction, option.waypoints, option.spacing_m) == (0.3, 0.5, 10, 0.1)
    assert config.planner.worlds == ("pillar(2,2,10)",)


@pytest.mark.parametrize("section", PRESETS)
def test_a_preset_states_only_what_differs_from_the_default(section: str) -> None:
    default = msgspec.to_builtins(SECTIONS[section]())
    for preset, values in PRESETS[section].items():
        assert values.keys() <= default.keys()
        assert not {key for key, value in values.items() if value == default[key]}, preset


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_a_shipped_file_loads_and_states_only_what_differs_from_the_default(path: Path) -> None:
    config = load_config(path)
    for line in path.read_text().splitlines():
        if line.startswith("  ") and not line.strip().startswith("#"):
            key = line.split(":")[0].strip()
            values = [
                (getattr(getattr(config, name), key, None), getattr(kind(), key, None))
                for name, kind in SECTIONS.items()
            ]
            assert any(value != default for value, default in values), line


def test_the_baseline_differs_from_the_point_in_its_preset_and_in_having_no_planner() -> None:
    baseline, point = (CONFIGS[0].with_name(f"{name}.yaml") for name in ("baseline-point", "point"))
    expected = load_config(point, ["skill.preset=baseline"])
    assert load_config(baseline) == msgspec.structs.replace(expected, planner=PlannerConfig())


def test_exponents_without_a_point_are_numbers(tmp_path: Path) -> None:
    config = load_text(tmp_path, "skill:\n  learning_rate: 3e-4\n  total_steps: 2_000_000\n")
    assert (config.skill.learning_rate, config.skill.total_steps) == (3e-4, 2_000_000)


@pytest.mark.parametrize("text", ["", "# nothing\n", "skill:\n", "---\n"])
def test_an_empty_file_or_section_changes_nothing(tmp_path: Path, text: str) -> None:
    assert load_text(tmp_path, text) == TrainConfig()


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("skill: {num_envs: 0}", ["skill.num_envs", "= 0", ">= 1"]),
        ("skill: {num_envs: 100_000}", ["skill.num_envs", "100000", "<= 65536"]),
        ("skill: {num_envs: 2.0}", ["skill.num_envs", "2.0", "int"]),
        ("skill: {num_envs: true}", ["skill.num_envs", "True", "int"]),
        ("skill: {num_envs: '8'}", ["skill.num_envs", "'8'", "int"]),
        ("skill: {num_envs: 010}", ["skill.num_envs", "'010'", "int"]),
        ("skill: {num_envs: }", ["skill.num_envs", "None", "int"]),
        ("skill: {mirror: on}", ["skill.mirror", "'on'", "true | false"]),
        ("skill: {discount: 1.0}", ["skill.discount", "1.0", "< 1"]),
        ("skill: {hidden: []}", ["skill.hidden", "[]", "at least 1"]),
        ("skill: {hidden: [256, 0]}", ["skill.hidden", "[256, 0]", "int >= 1"]),
        ("skill: {stop_reach_rate: 1.5}", ["skill.stop_reach_rate", "1.5", "null or float > 0 and <= 1"]),
        ("skill: {worlds: [maze]}", ["skill.worlds", "maze", "pillar(2,2,10)"]),
        ("planner: {worlds: [gremlin, maze]}", ["planner.worlds", "maze", "pillar(2,2,10)"]),
        ("planner: {preset: baseline}", ["planner.preset", "'baseline'", "default | paper"]),
        ("skill: {preset: [paper]}", ["skill.preset", "['paper']", "baseline | default | paper"]),
        ("reward: {goal: .nan}", ["reward.goal", "nan", "finite"]),
        ("reward: {goal: -.inf}", ["reward.goal", "-inf", "finite"]),
        ("reward: {goal: 2024-01-01}", ["reward.goal", "'2024-01-01'", "float"]),
        ("seed: -1", ["seed", "-1", ">= 0"]),
        ("seed: 99999999999999999999999", ["seed", "99999999999999999999999"]),
        ("robot: ant", ["robot", "'ant'", "car | doggo | point"]),
        ("skill: 3", ["skill = 3", "mapping"]),
        ("skill: [1]", ["skill = [1]", "mapping"]),
        ("[1, 2]", ["mapping", "list"]),
        ("just text", ["mapping", "str"]),
    ],
)
def test_a_wrong_value_is_refused_with_file_key_value_and_limit(tmp_path: Path, text: str, parts: list[str]) -> None:
    path = write(tmp_path, text)
    message = error_of(path)
    for part in [str(path), *parts]:
        assert part in message


@pytest.mark.parametrize(
    ("text", "key", "nearest"),
    [
        ("skill: {num_env: 3}", "skill.num_env", "skill.num_envs"),
        ("sklil: {}", "sklil", "skill"),
        ("num_envs: 3", "num_envs", "skill.num_envs"),
        ("planner: {learning_rte: 1}", "planner.learning_rte", "planner.learning_rate"),
        ("skill.num_envs: 3", "skill.num_envs", None),
        ("1: 2", "1", None),
        ("skill: {<<: {tau: 0.1}}", "skill.<<", None),
    ],
)
def test_an_unknown_key_is_refused_and_the_nearest_is_named(
    tmp_path: Path, text: str, key: str, nearest: str | None
) -> None:
    path = write(tmp_path, text)
    message = error_of(path)
    assert str(path) in message
    assert key in message
    assert (f"did you mean '{nearest}'" in message) == (nearest is not None)


@pytest.mark.parametrize(
    ("text", "line", "word"),
    [
        ("seed: 1\nskill: {tau: 0.1\n", 3, "expected"),
        ("seed: 1\n\tskill: 2\n", 2, "'\\t'"),
        ("seed: 1\nrobot: car\nseed: 2\n", 3, "repeated key 'seed'"),
        ("skill:\n  tau: 0.1\n  tau: 0.1\n", 3, "repeated key 'tau'"),
        ("seed: 1\nrun_dir: \x07\n", 2, "characters"),
        ("seed: 1\nrobot: !!python/name:os.system\n", 2, "tags are not accepted: '!!python/name:os.system'"),
        ('seed: 1\nskill: {num_envs: !!int ""}\n', 2, "tags are not accepted: '!!int'"),
        ("!!map {seed: 1}\n", 1, "tags are not accepted: '!!map'"),
        ("!!str seed: 1\n", 1, "tags are not accepted: '!!str'"),
        ("seed: 1\n? [a]\n: 2\n", 2, "unhashable"),
        ("seed: &other 1\nskill: *other\n", 2, "aliases are not accepted"),
        ("seed: 1\n---\nseed: 2\n", 2, "document"),
    ],
)
def test_malformed_yaml_is_refused_with_file_and_line(tmp_path: Path, text: str, line: int, word: str) -> None:
    path = write(tmp_path, text)
    message = error_of(path)
    assert message.startswith(f"{path}:{line}: malformed YAML")
    assert word in message


def test_a_few_lines_of_aliases_do_not_make_a_long_error(tmp_path: Path) -> None:
    doubling = "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]\n" for k in range(1, 40))
    assert len(error_of(write(tmp_path, f"a0: &a0 [x, x]\n{doubling}seed: *a39\n"))) < 500


def test_a_file_nested_too_deeply_is_refused(tmp_path: Path) -> None:
    assert "nested too deeply" in error_of(write(tmp_path, "seed: " + "[" * 600))


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    assert "No such file" in error_of(tmp_path / "absent.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"run_dir: caf\xe9\n")
    assert "not UTF-8" in error_of(tmp_path / "latin.yaml")


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("skill.num_envs=0", ["skill.num_envs = 0", ">= 1"]),
        ("skill.num_env=3", ["'skill.num_env'", "did you mean 'skill.num_envs'"]),
        ("skill=3", ["'skill' is a section", "such as 'skill.preset'"]),
        ("seed", ["'seed'", "key.path=value"]),
        ("=3", ["unknown key ''"]),
        ("skill.tau=[", ["skill.tau", "malformed YAML"]),
        ("skill.tau=", ["skill.tau = None", "float"]),
        ('seed=!!int ""', ["seed:1: malformed YAML: tags are not accepted: '!!int'"]),
        ("seed=!!bool foo", ["seed:1: malformed YAML: tags are not accepted: '!!bool'"]),
        ('seed=!!float ""', ["seed:1: malformed YAML: tags are not accepted: '!!float'"]),
        ("seed=!!timestamp foo", ["seed:1: malformed YAML: tags are not accepted: '!!timestamp'"]),
        ("seed=! foo", ["seed:1: malformed YAML: tags are not accepted: '!'"]),
    ],
)
def test_a_wrong_override_is_refused_and_not_blamed_on_the_file(
    tmp_path: Path, override: str, parts: list[str]
) -> None:
    message = error_of(write(tmp_path, "seed: 1\n"), override)
    assert message.startswith("command line")
    assert "robot.yaml" not in message
    for part in parts:
        assert part in message


def test_an_override_into_a_section_of_a_wrong_type_blames_the_file(tmp_path: Path) -> None:
    assert "robot.yaml: skill = 3" in error_of(write(tmp_path, "skill: 3\n"), "skill.tau=0.1")


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (["skill.buffer_size=100"], ["skill.batch_size = 256", "skill.buffer_size = 100"]),
        (
            ["skill.total_steps=200", "skill.learning_starts=0"],
            ["skill.batch_size = 256", "expected <= skill.total_steps = 200"],
        ),
        (
            ["skill.alpha_floor=0", "skill.alpha_floor_end=0.002"],
            ["skill.alpha_floor_end = 0.002", "expected null", "skill.alpha_floor = 0"],
        ),
        (["skill.preset=paper", "skill.alpha_floor_end=0.0"], ["skill.alpha_floor_end = 0", "skill.alpha_floor = 0"]),
        (
            ["planner.preset=paper", "planner.hypotheses=6"],
            ["planner.hypotheses = 6", "expected 1", "planner.preset = 'paper'"],
        ),
        (["skill.total_steps=1000"], ["skill.learning_starts = 2000", "skill.total_steps = 1000"]),
        (["skill.preset=baseline", "reward.preset=default"], ["reward.path_distance", "baseline"]),
        (["option.waypoints=12"], ["option.waypoints = 12", "expected 10", "observes"]),
        (["option.spacing_m=1.5"], ["option.waypoints = 10", "option.spacing_m = 1.5", "15 m", "at most 10 m"]),
    ],
)
def test_settings_that_contradict_each_other_are_refused(overrides: list[str], parts: list[str]) -> None:
    message = error_of(None, *overrides)
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    "settings",
    [
        ["skill.total_steps=200", "skill.learning_starts=0"],
        ["skill.alpha_floor=0", "skill.alpha_floor_end=0.002"],
        ["planner.preset=paper", "planner.hypotheses=6"],
    ],
)
def test_what_comes_to_nothing_does_not_keep_an_older_run_from_being_read(tmp_path: Path, settings: list[str]) -> None:
    config = load_config(None, settings, begun=True)
    path = write(tmp_path, dump_config(config))
    assert load_config(path, begun=True) == config
    assert "expected" in error_of(path)


def test_a_skill_observes_as_many_waypoints_as_plans_must_have_and_a_baseline_none() -> None:
    terms = {term.name: term.size for term in get_robot("point").observation_layout().terms}
    assert terms["waypoints"] == 2 * OptionConfig().waypoints
    assert load_config(None, ["skill.preset=baseline", "option.waypoints=12"]).option.waypoints == 12


def test_a_configuration_built_in_python_is_checked_too() -> None:
    config = TrainConfig(skill=SkillConfig(num_envs=0))
    with pytest.raises(ConfigError, match=r"skill\.num_envs = 0, expected int >= 1"):
        check_config(config)
    assert check_config(TrainConfig()) == TrainConfig()


@pytest.mark.parametrize("name", layout.KINDS)
def test_every_kind_of_world_can_be_configured(name: str) -> None:
    kind = layout.KINDS[name]
    texts = [name] if kind.default else []
    texts.append(f"{name}({','.join('3' for _ in kind.arguments.split(','))})")
    for text in texts:
        config = load_config(None, [f'planner.worlds=["2*{text}"]', f'skill.worlds=["{text}"]'])
        assert config.skill.worlds == (text,) and str(layout.parse_world(text)) == text
        assert kind.arguments in layout._ACCEPTED


def test_a_configuration_cannot_be_changed() -> None:
    with pytest.raises(AttributeError):
        TrainConfig().skill.tau = 0.5  # type: ignore[misc]


finite = st.floats(allow_nan=False, allow_infinity=False)
unit = st.floats(0, 1, exclude_min=True)


@st.composite
def configs(draw: st.DrawFn) -> TrainConfig:
    network = draw(st.sampled_from(["default", "paper"]))
    reward: dict[str, Any] = {
        name: draw(finite) for name in ("path_distance", "progress", "collision", "goal", "goal_distance")
    }
    return TrainConfig(
        robot=draw(st.sampled_from(["point", "car", "doggo"])),
        seed=draw(st.integers(0, 2**63 - 1)),
        run_dir=draw(
            st.none() | st.text(min_size=1) | st.sampled_from(["null", "true", "1e3", "-", "2024", "a: b", "<<", "#"])
        ),
        planner=PlannerConfig(
            preset=network,
            hypotheses=1 if network == "paper" else draw(st.integers(1, 16)),
            worlds=tuple(draw(st.lists(st.sampled_from(["pillar(2,2,10)", "gremlin", "map(a b.yaml)"]), min_size=1))),
            mirror=draw(st.booleans()),
        ),
        skill=SkillConfig(
            preset=draw(st.sampled_from(["default", "paper"])),
            hidden=tuple(draw(st.lists(st.integers(1, 512), min_size=1, max_size=4))),
            tau=draw(unit),
            target_entropy=draw(st.none() | finite),
        ),
        option=OptionConfig(invalid=draw(st.booleans()), period=draw(st.none() | st.integers(1, 1000))),
        reward=RewardConfig(preset=draw(st.sampled_from(["default", "paper", "baseline"])), **reward),
    )


@given(configs())
def test_a_written_configuration_reads_back_equal(
    tmp_path_factory: pytest.TempPathFactory, config: TrainConfig
) -> None:
    path = tmp_path_factory.getbasetemp() / "round_trip.yaml"
    path.write_text(dump_config(config), encoding="utf-8", newline="")
    assert load_config(path) == config


@given(configs())
def test_a_configuration_said_as_overrides_reads_back_equal_but_for_its_folder(config: TrainConfig) -> None:
    overrides = as_overrides(config)
    assert load_config(None, overrides) == msgspec.structs.replace(config, run_dir=None)
    assert not as_overrides(TrainConfig())


@given(st.text(alphabet=st.sampled_from("seedkil:num_vs-[]{}&*!|>'\"#%@`,.?~10 \n\t"), max_size=60))
def test_any_text_is_a_configuration_or_a_config_error(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_text(text, encoding="utf-8", newline="")
    try:
        assert isinstance(load_config(path), TrainConfig)
    except ConfigError as error:
        assert str(path) in str(error)


def test_help_describes_every_setting_with_its_type_and_default() -> None:
    described = {field.path: field for field in describe_config()}
    values = msgspec.to_builtins(TrainConfig())
    leaves = {key for key in values if key not in SECTIONS} | {f"{s}.{key}" for s in SECTIONS for key in values[s]}
    assert described.keys() == leaves
    assert all(field.description for field in described.values())
    assert described["skill.num_envs"].type == "int >= 1 and <= 65536"
    assert described["skill.num_envs"].default == SkillConfig().num_envs
    assert described["robot"].type == "car | doggo | point"
    assert described["skill.stop_reach_rate"].type == "null or float > 0 and <= 1"
    assert described["planner.worlds"].type.startswith("list of at least 1 of: a world")
    assert math.isclose(described["option.d_update_m"].default, 0.3)
    assert "at checkpoints: at the first one at or after that many" in described["skill.eval_every_steps"].description


@pytest.mark.parametrize("name", ["\x85", "\u2028runs", "größe"])
def test_a_folder_of_any_name_survives_writing_and_reading(tmp_path: Path, name: str) -> None:
    file = tmp_path / "config.yaml"
    config = msgspec.structs.replace(load_config(), run_dir=name)
    file.write_text(dump_config(config), encoding="utf-8")
    assert load_config(file) == config


def test_the_floor_of_the_temperature_falls_forwards() -> None:
    with pytest.raises(ConfigError, match=r"skill.alpha_fall = \[0.8, 0.4\], expected an earlier share first"):
        load_config(None, ["skill.alpha_fall=[0.8, 0.4]"])


def test_a_baseline_has_no_planner_network_to_follow() -> None:
    with pytest.raises(ConfigError, match="skill.planner = 'cnn', expected 'astar'"):
        load_config(None, ["skill.preset=baseline", "skill.planner=cnn"])


def test_the_longest_plan_of_a_configuration_is_what_an_option_follows() -> None:
    assert LONGEST_PLAN == option.LONGEST_PLAN
