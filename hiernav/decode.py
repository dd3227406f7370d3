"""Strict decoding of settings: YAML text to typed, frozen structs, with errors that say what to change and where.

The YAML read here is the 1.2 core schema: `3e-4` is a number, `on` and `010` are text, and a repeated key, an
alias and a tag are errors.
"""

from __future__ import annotations

import difflib
import functools
import json
import math
import re
import shlex
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, TypeVar

import msgspec
import yaml
from msgspec import inspect as types

from hiernav.nav.plain_yaml import PlainLoader

S = TypeVar("S", bound=msgspec.Struct)


class ConfigError(ValueError):
    """A setting or a file of settings that cannot be used; the message is one line for the user."""


class FieldHelp(NamedTuple):
    """One setting, as `--help` shows it."""

    path: str
    """Key path, `skill.num_envs`."""
    type: str
    """Accepted values, `int >= 1`."""
    default: Any
    description: str


class _Field(NamedTuple):
    help: FieldHelp
    nested: type[msgspec.Struct] | None


def parse_yaml(text: str, source: str) -> Any:
    """Read one YAML document.

    Args:
        source: name of the file (or other origin) for messages.

    Raises:
        ConfigError: malformed YAML, a repeated key, an alias or a tag; names source and line.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        raise ConfigError(f"{source}:{line}: malformed YAML: {error.problem or error.context}") from None
    except yaml.reader.ReaderError as error:
        line = text[: error.position].count("\n") + 1
        raise ConfigError(f"{source}:{line}: malformed YAML: {error.reason}") from None
    except RecursionError:
        raise ConfigError(f"{source}: malformed YAML: nested too deeply") from None
    except ValueError as error:
        raise ConfigError(f"{source}: malformed YAML: {error}") from None


def dump_yaml(values: dict[str, Any]) -> str:
    """Write settings as YAML that `parse_yaml` reads back equal: what is not ASCII is escaped, line separators too."""
    return yaml.dump(values, Dumper=_Dumper, sort_keys=False, width=120)


def decode(kind: type[S], values: Any, source: str | Callable[[str], str]) -> S:
    """Turn plain values into the struct `kind`, checking every key, type and range.

    Args:
        source: origin for messages, or a function from key path to origin.

    Raises:
        ConfigError: unknown key, wrong type, out of range or not finite; names source, key path, value and limit.
    """
    origin = (lambda path: source) if isinstance(source, str) else source
    fields = _fields(kind)
    for path, value in _leaves(values, fields):
        if path not in fields:
            raise ConfigError(f"{origin(path)}: {unknown_key(path, fields)}")
        if fields[path].nested and not isinstance(value, dict):
            raise ConfigError(f"{origin(path)}: {path} = {value!r}, expected a mapping")
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{origin(path)}: {path} = {value!r}, expected {fields[path].help.type}, finite")
    try:
        return msgspec.convert(values, kind)
    except msgspec.ValidationError as error:
        where = re.search(r"`\$\.?([\w.]*)", str(error))
        path = where.group(1) if where else ""
        if path not in fields:
            raise ConfigError(f"{origin(path)}: {error}") from None
        raise ConfigError(
            f"{origin(path)}: {path} = {_value_at(values, path)!r}, expected {fields[path].help.type}"
            f"{_way_to_write(path, _value_at(values, path), fields[path].help.type)}"
        ) from None


def describe(kind: type[msgspec.Struct]) -> list[FieldHelp]:
    """Every setting of a struct and of the structs in it, in order of declaration."""
    return [field.help for field in _fields(kind).values() if field.nested is None]


def as_text(value: Any) -> str:
    """A setting's value as it is written in YAML, on one line."""
    return json.dumps(value)


def unknown_key(path: str, known: Iterable[str]) -> str:
    """Message for a key that does not exist, with the nearest one that does."""
    known = list(known)
    leaf = path.rpartition(".")[2]
    near = difflib.get_close_matches(path, known, 1, 0.75) or [k for k in known if k.rpartition(".")[2] == leaf]
    return f"unknown key {path!r}" + (f", did you mean {near[0]!r}?" if near else "")


@functools.cache
def _fields(kind: type[msgspec.Struct], prefix: str = "") -> dict[str, _Field]:
    """Key path -> field of a struct, sections included, sections before what is in them."""
    found: dict[str, _Field] = {}
    info = types.type_info(kind)
    assert isinstance(info, types.StructType)
    for field in info.fields:
        path = prefix + field.encode_name
        default = field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
        bare = field.type.type if isinstance(field.type, types.Metadata) else field.type
        nested = bare.cls if isinstance(bare, types.StructType) else None
        found[path] = _Field(FieldHelp(path, _type_text(field.type), default, _description(field.type)), nested)
        if nested:
            found |= _fields(nested, path + ".")
    return found


def _description(kind: types.Type) -> str:
    return (kind.extra_json_schema or {}).get("description", "") if isinstance(kind, types.Metadata) else ""


def _type_text(kind: types.Type) -> str:
    """Accepted values in words: `int >= 1`, `car | point`, `list of float > 0`, `null or str`."""
    match kind:
        case types.Metadata():
            return (kind.extra or {}).get("accepts") or _type_text(kind.type)
        case types.IntType() | types.FloatType():
            name = "int" if isinstance(kind, types.IntType) else "float"
            limits = [(">", kind.gt), (">=", kind.ge), ("<", kind.lt), ("<=", kind.le)]
            return f"{name} {' and '.join(f'{sign} {limit:g}' for sign, limit in limits if limit is not None)}".strip()
        case types.LiteralType():
            return " | ".join(map(str, kind.values))
        case types.BoolType():
            return "true | false"
        case types.TupleType():
            return f"list of {len(kind.item_types)}: {_type_text(kind.item_types[0])}"
        case types.VarTupleType() | types.ListType():
            least = f"at least {kind.min_length} of: " if kind.min_length else ""
            return f"list of {least}{_type_text(kind.item_type)}"
        case types.UnionType():
            return " or ".join(sorted((_type_text(t) for t in kind.types), key=lambda text: text != "null"))
        case types.NoneType():
            return "null"
        case types.StrType():
            return "text"
        case _:
            return "a mapping"


def _leaves(values: Any, fields: dict[str, _Field], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Key path and value of everything in nested mappings; unknown and wrongly typed sections are not entered."""
    for key, value in values.items():
        path = f"{prefix}{key}"
        yield path, value
        if isinstance(value, dict) and path in fields and fields[path].nested:
            yield from _leaves(value, fields, path + ".")


def _way_to_write(path: str, value: Any, wanted: str) -> str:
    """How a value of nearly the wanted type is written, as an argument in a shell."""
    if isinstance(value, str) and "list of" in wanted:
        entries = re.split(r",\s*(?![^()]*\))", value)
        numbers = all(re.fullmatch(r"[-+.\d]+", entry) for entry in entries)
        right = f"[{', '.join(entries)}]" if numbers else as_text(entries)
    elif isinstance(value, float) and wanted.startswith("int") and value.is_integer():
        right = str(int(value))
    else:
        return ""
    return f"; write {shlex.quote(f'{path}={right}')}"


def _value_at(values: Any, path: str) -> Any:
    for key in path.split("."):
        values = values[key]
    return values


# (tag, pattern, possible first characters), tried in this order; other plain text is a string.
_CORE_SCHEMA = [
    ("null", r"^(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    ("bool", r"^(?:true|True|TRUE|false|False|FALSE)$", list("tTfF")),
    ("int", r"^[-+]?(?:0|[1-9][0-9_]*)$", list("-+0123456789")),
    (
        "float",
        r"^[-+]?(?:(?:\.[0-9]+|[0-9]+\.[0-9]*)(?:[eE][-+]?[0-9]+)?|[0-9]+[eE][-+]?[0-9]+)$",
        list("-+.0123456789"),
    ),
    ("float", r"^(?:[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$", list("-+.")),
]


class _Loader(PlainLoader):
    yaml_implicit_resolvers: dict[str, list[Any]] = {}

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        problem=f"repeated key {key.value!r}", problem_mark=key.start_mark
                    )
                seen.add(key.value)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    # The writer must quote what the reader would not take for text.
    yaml_implicit_resolvers: dict[str, list[Any]] = {}

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(
    list, lambda dumper, values: dumper.represent_sequence("tag:yaml.org,2002:seq", values, flow_style=True)
)
for _tag, _pattern, _first in _CORE_SCHEMA:
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), _first)
