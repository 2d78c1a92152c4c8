"""What commands share: flags read and results printed, names validated, compiled programs kept."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from typing import Annotated, Any, NamedTuple, Protocol

import tyro
from tyro.conf import arg

from vatmart_jax.errors import require_one_of

JsonFlag = Annotated[bool, arg(help="print one JSON object as the last line of standard output")]


class Output(NamedTuple):
    """What a command found."""

    result: dict[str, Any]  # for --json
    text: str = ""  # for people, beside the JSON on standard error
    only_text: bool = False  # people need not see it where there is JSON


class Runnable(Protocol):
    """A command: a dataclass of flags, `json` among them."""

    json: bool

    def run(self) -> dict[str, Any] | Output: ...


def run_command(command: type[Any], argv: list[str], prog: str) -> None:
    """Read the flags of a command, run it, and print what it found."""
    args: Runnable = tyro.cli(command, args=argv, prog=prog)
    print_output(args.run(), args.json)


def print_output(output: dict[str, Any] | Output, as_json: bool) -> None:
    """JSON as the last line of standard output, or the text, or else the result a line per key."""
    import sys

    result, text, only_text = output if isinstance(output, Output) else Output(output)
    if text and not (as_json and only_text):
        print(text, file=sys.stderr if as_json else sys.stdout)
    if as_json:
        print(json.dumps(result))
    elif not text:
        for key, value in result.items():
            print(f"{key}: {value}")


def names(flag: str, text: str, known: Iterable[str]) -> tuple[str, ...]:
    """Names joined by commas. Raises UserError, which lists the known ones, where one is unknown."""
    found, known = tuple(text.split(",")), tuple(known)
    for name in found:
        require_one_of(flag, name, known)
    return found


def physics_impl(given: str | None) -> str:
    """The value of --impl, or what is best here. Raises UserError for an unknown one."""
    from vatmart_jax.physics import BACKENDS, default_impl

    if given is None:
        return default_impl()
    require_one_of("--impl", given, BACKENDS.names())
    return given


def peek(argv: list[str], flag: str) -> str | None:
    """The value of a flag that decides the defaults of others."""
    for i, word in enumerate(argv):
        if word == flag and i + 1 < len(argv):
            return argv[i + 1]
        if word.startswith(flag + "="):
            return word.split("=", 1)[1]
    return None


def prepare_jax() -> None:
    """Before a command first uses JAX. Compiled programs are kept between runs, which saves a minute or two of every
    run after the first."""
    import jax

    from vatmart_jax.data.cache import cache_folder
    from vatmart_jax.host_threads import allow_callbacks

    allow_callbacks()
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
