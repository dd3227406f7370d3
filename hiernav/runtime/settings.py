"""Settings of the runtime: one section per concern, from a YAML file and `section.key=value` on the command line."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, get_type_hints

import msgspec

from hiernav.decode import ConfigError, parse_yaml
from hiernav.runtime.driver_config import DriverConfig
from hiernav.runtime.estimate import EstimatorConfig
from hiernav.runtime.guard import GuardConfig
from hiernav.runtime.noise import SensorNoise
from hiernav.runtime.realtime import RealtimeConfig


@dataclass(frozen=True)
class Settings:
    """What may differ from robot to robot and from host to host. What the networks depend on is in their bundle."""

    driver: DriverConfig = field(default_factory=DriverConfig)
    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)
    guard: GuardConfig = field(default_factory=GuardConfig)
    realtime: RealtimeConfig = field(default_factory=RealtimeConfig)
    noise: SensorNoise = field(default_factory=SensorNoise)
    """Of simulated sensors."""


_SECTIONS: dict[str, Any] = get_type_hints(Settings)


def load_settings(
    paths: Sequence[Path] = (),
    overrides: Sequence[str] = (),
    defaults: Mapping[str, Mapping[str, Any]] | None = None,
) -> Settings:
    """Defaults, then the files, each over those before it, then `section.key=value` overrides.

    Args:
        paths: YAML files with some of the sections.
        overrides: as on the command line.
        defaults: values by section and key that the robot itself asks for.

    Raises:
        ConfigError: the file cannot be read, or a section, key or value is not one that `Settings` takes; names the
            file or the command line, whichever it came from.
    """
    values = {name: dict(section) for name, section in (defaults or {}).items()}
    sources: dict[str, list[tuple[str, str | None]]] = {}
    for path in paths:
        for name, section in _read(path).items():
            _known(name, list(_SECTIONS), str(path))
            if not isinstance(section, dict):
                raise ConfigError(f"{path}: {name} must be a section with settings, it is {section!r}")
            for key in section:
                _known(key, _keys(name), f"{path}: {name}")
            values.setdefault(name, {}).update(section)
            sources.setdefault(name, []).append((str(path), _error(name, values[name])))
    given: dict[str, dict[str, Any]] = {}
    for override in overrides:
        key, equals, text = override.partition("=")
        name, dot, leaf = key.partition(".")
        if not (equals and dot):
            raise ConfigError(f"command line: {override!r}, expected section.key=value")
        _known(name, list(_SECTIONS), "command line")
        _known(leaf, _keys(name), f"command line: {name}")
        given.setdefault(name, {})[leaf] = parse_yaml(text, f"command line: {key}")
    names = [name for name in _SECTIONS if name in values or name in given]
    return Settings(
        **{name: _section(name, values.get(name, {}), given.get(name, {}), sources.get(name, [])) for name in names}
    )


def differing(settings: Settings) -> dict[str, Any]:
    """The values that are not this package's defaults, by `section.key`, whoever has set them."""
    usual = Settings()
    return {
        f"{section}.{key}": value
        for section in _SECTIONS
        for key, value in vars(getattr(settings, section)).items()
        if value != getattr(getattr(usual, section), key)
    }


def _section(
    name: str, values: Mapping[str, Any], given: Mapping[str, Any], sources: Sequence[tuple[str, str | None]]
) -> Any:
    """A section of `values` with what was `given` on the command line over it.

    Args:
        sources: files that the values are from, each with what was wrong with them after it was read.

    Raises:
        ConfigError: names the first file with which it was wrong, or the command line where the section could be used
            without what was given there.
    """
    error = _error(name, {**values, **given})
    if error is None:
        return msgspec.convert({**values, **given}, _SECTIONS[name])
    if not given or _error(name, values) == error:
        file = next((file for file, wrong in sources if wrong == error), "settings")
        raise ConfigError(f"{file}: {name}: {error}")
    blamed = [key for key in given if key in error] or list(given)
    raise ConfigError(f"command line: {', '.join(f'{name}.{key}' for key in blamed)}: {error}")


def _error(name: str, values: Mapping[str, Any]) -> str | None:
    """Why a section cannot be made of these values; None where it can."""
    try:
        msgspec.convert(dict(values), _SECTIONS[name])
    except (msgspec.ValidationError, ValueError) as error:
        return str(error)
    return None


def _keys(name: str) -> list[str]:
    return [each.name for each in fields(_SECTIONS[name])]


def _known(key: str, known: list[str], where: str) -> None:
    if key in known:
        return
    near = difflib.get_close_matches(str(key), known, 1)
    hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
    raise ConfigError(f"{where}: unknown setting {key!r}; {hint}")


def _read(path: Path) -> dict[str, Any]:
    try:
        values = parse_yaml(path.read_text(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected sections with settings")
    return values
