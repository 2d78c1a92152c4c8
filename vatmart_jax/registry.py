"""Registries of what can be exchanged, and the plugins that add to them.

A value is registered itself, or as an import string `module:attribute` that is resolved when it is first asked for, so
that a registry imports none of its entries. Plugins are modules or .py files named in the environment variable
VATMART_PLUGINS (separated by commas or `os.pathsep`), never by a data file; worker processes inherit it.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, TypeVar, cast, overload

from vatmart_jax.errors import UserError, summarize_error

PLUGINS = "VATMART_PLUGINS"
T = TypeVar("T")
V = TypeVar("V")


class Registry(Generic[T]):
    """Values of one kind by name, in the order in which they were registered."""

    def __init__(self, kind: str):
        """kind: what the values are, for error messages ("object reader")."""
        self.kind = kind
        self._entries: dict[str, T | str] = {}

    @overload
    def register(self, name: str) -> Callable[[V], V]: ...
    @overload
    def register(self, name: str, value: T | str) -> None: ...
    def register(self, name: str, value: Any = None) -> Any:
        """Add a value, or the import string of one; without a value, a decorator that adds what it decorates.

        Raises ValueError where the name is taken.
        """
        if value is None:

            def decorate(decorated: V) -> V:
                self.register(name, cast(T, decorated))
                return decorated

            return decorate
        if name in self._entries:
            raise ValueError(f"{self.kind} {name!r} is registered already")
        self._entries[name] = value
        return None

    def unregister(self, name: str) -> None:
        """Forget a name, so that it can be registered again (in a notebook, after a test)."""
        self._entries.pop(name, None)

    def get(self, name: str) -> T:
        """Raises UserError, which lists the known names, where there is none of this name."""
        if name not in self._entries:
            raise UserError(f"{self.kind} {name!r} is not known; use one of {', '.join(self._entries)}")
        value = self._entries[name]
        if isinstance(value, str):
            module, _, attribute = value.partition(":")
            value = cast(T, getattr(importlib.import_module(module), attribute))
            self._entries[name] = value
        return value

    def names(self) -> tuple[str, ...]:
        return tuple(self._entries)


def load_plugins() -> None:
    """Import what VATMART_PLUGINS names, each once per process. Raises UserError where that fails."""
    for entry in os.environ.get(PLUGINS, "").replace(os.pathsep, ",").split(","):
        if entry := entry.strip():
            try:
                _load(entry)
            except Exception as e:  # a plugin raises whatever it runs into
                why = f"{type(e).__name__}: {summarize_error(e)}"
                raise UserError(f"{PLUGINS}: {entry}: not loaded ({why}); name a module or a .py file") from e


def _load(entry: str) -> None:
    if not entry.endswith(".py"):
        importlib.import_module(entry)
        return
    path = Path(entry).resolve()
    name = f"vatmart_plugin_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
