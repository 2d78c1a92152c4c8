"""Nested frozen dataclasses from JSON and back: the resolved config beside every result is enough to load it again."""

from __future__ import annotations

import json
import types
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


class Variant:
    """Base of the dataclasses of which a field may hold any one; in JSON, `kind` says which."""

    kind: ClassVar[str]
    default_kind: ClassVar[str]
    """of JSON without one"""

    @classmethod
    def of_kind(cls, kind: str) -> type:
        """The dataclass of this kind. Raises UserError where there is none."""
        raise NotImplementedError


def to_json(config: Any) -> dict[str, Any]:
    """A dataclass as JSON has it: tuples are lists."""
    return json.loads(json.dumps(_plain(config)))


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        kind = {"kind": value.kind} if isinstance(value, Variant) else {}
        return kind | {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, dict):
        return {name: _plain(v) for name, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, list | tuple) else value


def from_json(kind: type[T], value: Any, where: str = "config") -> T:
    """The dataclass `kind` with the fields of a JSON object; those that it lacks take their defaults.

    So a new field's default is what was done before it existed, or the format's number rises and a migration fills it
    in. Field types: dataclasses, tuples, str, int, float, bool, Literal and Optional of them. Raises ValueError, which
    names the field, for one that is unknown, does not fit, or is missing without default.
    """
    if not isinstance(value, dict):
        raise ValueError(f"{where}: expected an object, found {type(value).__name__}")
    if isinstance(kind, type) and issubclass(kind, Variant):
        value = {"kind": kind.default_kind} | value
        kind = kind.of_kind(value.pop("kind"))
    hints = get_type_hints(kind)
    known = {f.name: f for f in fields(kind)}  # pyright: ignore[reportArgumentType]
    needed = {name for name, f in known.items() if f.default is MISSING and f.default_factory is MISSING}
    wrong = sorted((value.keys() - known.keys()) | (needed - value.keys()))
    if wrong:
        raise ValueError(f"{where}: fields {', '.join(wrong)} are missing or unknown")
    return kind(**{name: _parsed(hints[name], found, f"{where}.{name}") for name, found in value.items()})


def _parsed(kind: Any, value: Any, where: str) -> Any:
    if is_dataclass(kind) or (isinstance(kind, type) and issubclass(kind, Variant)):
        return from_json(kind, value, where)  # pyright: ignore[reportArgumentType]
    origin = get_origin(kind)
    if origin in (Union, types.UnionType):
        return _parsed_optional(kind, value, where)
    if origin is Literal:
        known = get_args(kind)
        if value not in known or type(value) not in {type(k) for k in known}:
            raise ValueError(f"{where}: expected one of {', '.join(map(str, known))}, found {value}")
        return value
    if origin is tuple:
        return _parsed_tuple(get_args(kind), value, where)
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise ValueError(f"{where}: expected {kind.__name__}, found {type(value).__name__}")
    return value


def _parsed_optional(kind: Any, value: Any, where: str) -> Any:
    """Of a type or None."""
    if value is None:
        return None
    (inner,) = (k for k in get_args(kind) if k is not types.NoneType)
    return _parsed(inner, value, where)


def _parsed_tuple(kinds: tuple[Any, ...], value: Any, where: str) -> tuple:
    if not isinstance(value, list):
        raise ValueError(f"{where}: expected a list, found {type(value).__name__}")
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(value)
    if len(kinds) != len(value):
        raise ValueError(f"{where}: expected {len(kinds)} values, found {len(value)}")
    return tuple(_parsed(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(kinds, value, strict=True)))
