"""Every leaf of a config changed by itself, and which of these changes nothing shows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any


def perturbed(value: Any) -> Iterator[tuple[str, Any]]:
    """Every leaf of nested dataclasses and tuples, by path, and the whole with that leaf changed.

    Strings, tuples of them and empty tuples are leaves that have no obvious other value.
    """
    if is_dataclass(value):
        for field in fields(value):
            for path, changed in perturbed(getattr(value, field.name)):
                yield f".{field.name}{path}", lambda c=changed, n=field.name: replace(value, **{n: c()})
    elif isinstance(value, tuple) and value and not isinstance(value[0], str):
        for i, item in enumerate(value):
            for path, changed in perturbed(item):
                yield f"[{i}]{path}", lambda c=changed, i=i: (*value[:i], c(), *value[i + 1 :])
    else:
        yield "", lambda: _other(value)


def _other(value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    return value + 1 if isinstance(value, int) else 0.4 * value + 0.01


def without_effect(
    config: Any, observe: Callable[[Any], Iterator[Any]], special: Mapping[str, Any] | None = None
) -> list[str]:
    """Paths of the leaves whose change none of the observations shows. `special`: configs for leaves that cannot be
    changed alone, or have no obvious other value. Raises AssertionError where observations of one config differ."""
    special = special or {}
    before: list[Any] = []
    source, again = observe(config), observe(config)
    silent, found = [], set()
    for path, changed in perturbed(config):
        found.add(path)
        other = special[path] if path in special else changed()
        assert other != config, f"{path} was not changed"
        for i, seen in enumerate(observe(other)):
            if i == len(before):
                before.append(next(source))
                assert before[i] == next(again), "what is observed changes by itself"
            if seen != before[i]:
                break
        else:
            silent.append(path)
    assert found >= set(special), "special leaves that are not there"
    return silent
