"""Registries resolve late, name what they know, and are added to by plugins alone."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from vatmart_jax.errors import UserError
from vatmart_jax.registry import PLUGINS, Registry, load_plugins


def test_values_and_import_strings_come_back_by_name():
    registry: Registry[type] = Registry("thing")
    registry.register("path", "pathlib:Path")
    registry.register("int", int)

    @registry.register("mine")
    class Mine:
        pass

    assert registry.get("path") is Path and registry.get("int") is int and registry.get("mine") is Mine
    assert registry.names() == ("path", "int", "mine")


def test_an_import_string_is_not_imported_before_it_is_asked_for():
    registry: Registry[object] = Registry("thing")
    registry.register("late", "this_module_does_not_exist:value")
    with pytest.raises(ModuleNotFoundError):
        registry.get("late")


def test_an_unknown_name_lists_the_known_ones_and_a_taken_one_is_refused():
    registry: Registry[int] = Registry("object reader")
    registry.register("a", 1)
    registry.register("b", 2)
    with pytest.raises(UserError, match="object reader 'c' is not known; use one of a, b"):
        registry.get("c")
    with pytest.raises(ValueError, match="'a' is registered already"):
        registry.register("a", 3)
    registry.unregister("a")
    registry.register("a", 3)
    assert registry.get("a") == 3


def test_plugins_are_files_or_modules_and_load_once(tmp_path, monkeypatch):
    (tmp_path / "one.py").write_text("import builtins\nbuiltins.loaded_plugins.append(__name__)\n")
    (tmp_path / "two_plugin_module.py").write_text("import builtins\nbuiltins.loaded_plugins.append(__name__)\n")
    loaded: list[str] = []
    monkeypatch.setattr("builtins.loaded_plugins", loaded, raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(PLUGINS, f"{tmp_path / 'one.py'}, two_plugin_module")
    for _ in range(2):
        load_plugins()
    assert len(loaded) == 2 and loaded[1] == "two_plugin_module"
    for name in loaded:
        del sys.modules[name]


@pytest.mark.parametrize("entry", ["nowhere.py", "no_such_module", "broken.py"])
def test_a_plugin_that_does_not_load_is_named(tmp_path, monkeypatch, entry):
    (tmp_path / "broken.py").write_text("1 / 0\n")
    monkeypatch.setenv(PLUGINS, str(tmp_path / entry) if entry.endswith(".py") else entry)
    with pytest.raises(UserError, match=f"{PLUGINS}: .*{entry}: not loaded .*; name a module or a .py file"):
        load_plugins()


def test_no_plugins_is_the_default(monkeypatch):
    monkeypatch.delenv(PLUGINS, raising=False)
    load_plugins()
