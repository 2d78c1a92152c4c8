"""The `vatmart` command. Progress and logs go to standard error; `--json` prints one object on standard output.

One module per command, imported when that command is called: `vatmart --help` imports nothing heavy.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import NamedTuple

from vatmart_jax import __version__
from vatmart_jax.errors import UserError


class Command(NamedTuple):
    """A command: what it does, in one line, and where it is."""

    summary: str
    target: str  # module:dataclass with `run`, or module:function of the words behind the command's name


COMMANDS: dict[str, Command] = {
    "convert": Command("Convert PartNet-Mobility objects to MJCF, reports and banks.", "conversion.command:Convert"),
    "generate": Command(
        "Make objects in PartNet-Mobility's layout: procedural ones, or stretched copies of others.",
        "mjcf_assets.command:Generate",
    ),
    "train": Command("Train priors for one task: all stages, resumable.", "vatmart_jax.cli.train:main"),
    "evaluate": Command(
        "Evaluate trained priors: success rates and the priors' metrics.", "vatmart_jax.cli.evaluate:Evaluate"
    ),
    "predict": Command("Predict where and how to act on a point cloud.", "vatmart_jax.cli.predict:Predict"),
    "export": Command(
        "Write a run's priors so that they stand alone: Flax, StableHLO.", "vatmart_jax.cli.export:Export"
    ),
    "play": Command("Show one trial as an animated picture, or in MuJoCo's viewer.", "vatmart_jax.cli.play:Play"),
    "bench": Command("Measure speed and agreement: bench physics, parity or perception.", "vatmart_jax.cli.bench:main"),
}


def main(argv: list[str] | None = None) -> None:
    """Entry point. Exit codes: 0 done, 2 bad input (one line on standard error), 130 stopped."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        try:
            _dispatch(argv)
        finally:
            sys.stdout.flush()  # here, where a closed pipe is no error, and not while Python exits
    except UserError as e:
        sys.exit(_fail(str(e)))
    except KeyboardInterrupt:
        print("vatmart: stopped; rerun the same command to resume", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        # Whoever read our output has seen enough (`| head`); Python's own flush at exit would fail once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)  # as a shell reports SIGPIPE
    except OSError as e:
        where = f"{e.filename}: " if e.filename else ""
        sys.exit(_fail(f"{where}{e.strerror or e}; check the path, its permissions and the space left on the disk"))


def _dispatch(argv: list[str]) -> None:
    if argv[:1] == ["--version"]:
        print(__version__)
    elif argv[:1] in (["-h"], ["--help"]):
        print(_usage())
        sys.exit(0)
    elif not argv or argv[0] not in COMMANDS:
        print(_usage(), file=sys.stderr)
        sys.exit(2)
    else:
        from vatmart_jax.registry import load_plugins

        load_plugins()
        _run(argv[0], argv[1:])


def _run(name: str, argv: list[str]) -> None:
    module, _, attribute = COMMANDS[name].target.partition(":")
    target = getattr(importlib.import_module(module), attribute)
    if not isinstance(target, type):
        target(argv)
        return
    from vatmart_jax.cli.common import run_command

    run_command(target, argv, f"vatmart {name}")


def _fail(message: str) -> int:
    print(f"vatmart: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _usage() -> str:
    rows = "\n".join(f"  {name:<10} {command.summary}" for name, command in COMMANDS.items())
    return f"usage: vatmart COMMAND [flags]\n\n{rows}\n\n`vatmart COMMAND --help` lists the flags of one."
