"""The `vatmart` command. Progress and logs go to standard error; `--json` prints one object on standard output."""

# No postponed annotations here: tyro reads those of the commands' dataclasses, which only their functions see.
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional, arg

from vatmart_jax import __version__
from vatmart_jax.errors import UserError

_Json = Annotated[bool, arg(help="print one JSON object as the last line of standard output")]


def main(argv: list[str] | None = None) -> None:
    """Entry point. Exit codes: 0 done, 2 bad input (one line on standard error), 130 stopped."""
    argv = sys.argv[1:] if argv is None else argv
    if argv[:1] == ["--version"]:
        print(__version__)
        return
    if not argv or argv[0] not in COMMANDS:
        print(_usage(), file=sys.stdout if argv[:1] in (["-h"], ["--help"]) else sys.stderr)
        sys.exit(0 if argv[:1] in (["-h"], ["--help"]) else 2)
    try:
        COMMANDS[argv[0]](argv[1:])
    except UserError as e:
        sys.exit(_fail(str(e)))
    except KeyboardInterrupt:
        print("vatmart: stopped; the same command goes on where it was", file=sys.stderr)
        sys.exit(130)
    except OSError as e:
        where = f"{e.filename}: " if e.filename else ""
        sys.exit(_fail(f"{where}{e.strerror or e}; check the path, its permissions and the space left on the disk"))


def _fail(message: str) -> int:
    print(f"vatmart: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _usage() -> str:
    rows = "\n".join(f"  {name:<10} {(run.__doc__ or '').splitlines()[0]}" for name, run in COMMANDS.items())
    return f"usage: vatmart COMMAND [flags]\n\n{rows}\n\n`vatmart COMMAND --help` lists the flags of one."


def _print_result(result: dict[str, Any], as_json: bool, table: str = "") -> None:
    if table:
        print(table, file=sys.stderr if as_json else sys.stdout)
    if as_json:
        print(json.dumps(result))
    elif not table:
        for key, value in result.items():
            print(f"{key}: {value}")


def _convert(argv: list[str]) -> None:
    """Convert PartNet-Mobility objects to MJCF, reports and banks."""
    from conversion.convert import ConvertConfig, convert

    @dataclass(frozen=True)
    class Convert:
        """Convert PartNet-Mobility objects to MJCF, reports and banks. What is up to date is left as it is."""

        src: Positional[tuple[Path, ...]]
        """object folders, or folders of such folders"""
        out: Path
        jobs: int | None = None
        """processes; default one per core"""
        json: _Json = False
        config: Annotated[ConvertConfig, arg(name="")] = field(default_factory=ConvertConfig)

    args = tyro.cli(Convert, args=argv, prog="vatmart convert")
    if not args.src:
        raise UserError("no source; give one or more object folders, or folders of such folders")
    result = convert(args.src, args.out, args.config, args.jobs)
    _print_result(asdict(result), args.json)


def _generate(argv: list[str]) -> None:
    """Make procedural objects in PartNet-Mobility's layout."""
    from mjcf_assets.generator import generate

    @dataclass(frozen=True)
    class Generate:
        """Make procedural objects in PartNet-Mobility's layout, the same ones for the same seed."""

        out: Path
        count: int = 200
        seed: int = 0
        json: _Json = False

    args = tyro.cli(Generate, args=argv, prog="vatmart generate")
    start = time.monotonic()
    ids = generate(args.out, args.count, args.seed)
    _print_result({"objects": len(ids), "seconds": round(time.monotonic() - start, 2)}, args.json)


def _train(argv: list[str]) -> None:
    """Train priors for one task: all stages, resumable."""
    from vatmart_jax.presets import PRESETS, Settings

    chosen = _peek(argv, "--preset") or "quick"
    if chosen not in PRESETS:
        raise UserError(f"--preset {chosen}: not one of {', '.join(PRESETS)}")

    @dataclass(frozen=True)
    class Train:
        """Train priors for one task: exploration, perception, curiosity, finetuning, evaluation, pictures.

        Killed at any moment, the same command goes on where it was.
        """

        task: str
        """push-door, pull-door, push-drawer or pull-drawer"""
        out: Path
        """run folder"""
        data: Path | None = None
        """a folder of objects, or what `vatmart convert` made of it; default the bundled objects"""
        preset: str = chosen
        """quick, cpu, gpu or paper; the flags below start from it"""
        impl: str = "c"
        """physics"""
        seed: int = 0
        json: _Json = False
        settings: Annotated[Settings, arg(name="")] = field(default_factory=lambda: PRESETS[chosen])

    args = tyro.cli(Train, args=argv, prog="vatmart train")
    _enable_compilation_cache()
    from vatmart_jax.pipeline.run import check_folder
    from vatmart_jax.progress import Bars
    from vatmart_jax.training import resolve, train

    config = resolve(args.task, args.preset, args.impl, args.seed, args.settings, args.data)
    check_folder(args.out, config)
    with Bars() as bars:
        result, table = train(config, args.settings, _prepared(args.data, bars.say), args.out, bars)
    _print_result(result, args.json, table)


def _evaluate(argv: list[str]) -> None:
    """Evaluate trained priors: success rates and the priors' metrics."""

    @dataclass(frozen=True)
    class Evaluate:
        """Evaluate trained priors on test shapes and unseen categories."""

        run: Positional[tuple[Path, ...]]
        """run folders of `vatmart train`"""
        data: Path | None = None
        """default: the data that the run was trained on"""
        metrics: str = "priors,downstream"
        """priors, downstream, or both"""
        methods: str = "ours,random"
        """of downstream: ours, random"""
        trials: int = 350
        """per method and split"""
        seed: int = 1
        out: Path | None = None
        """folder for evaluation.json and evaluation.md; default the run folder"""
        json: _Json = False

    args = tyro.cli(Evaluate, args=argv, prog="vatmart evaluate")
    if not args.run:
        raise UserError("no run; give one or more run folders of `vatmart train`")
    _enable_compilation_cache()
    from vatmart_jax.evaluation.evaluate import evaluate
    from vatmart_jax.progress import Bars

    with Bars() as bars:
        result, table = evaluate(
            args.run,
            lambda data: _prepared(data, bars.say),
            args.data,
            tuple(args.metrics.split(",")),
            tuple(args.methods.split(",")),
            args.trials,
            args.seed,
            args.out,
            bars,
        )
    _print_result(result, args.json, table)


COMMANDS: dict[str, Callable[[list[str]], None]] = {
    "convert": _convert,
    "generate": _generate,
    "train": _train,
    "evaluate": _evaluate,
}


def _peek(argv: list[str], flag: str) -> str | None:
    """The value of a flag that decides the defaults of others."""
    for i, word in enumerate(argv):
        if word == flag and i + 1 < len(argv):
            return argv[i + 1]
        if word.startswith(flag + "="):
            return word.split("=", 1)[1]
    return None


def _prepared(data: Path | None, say: Callable[[str], None]) -> Path:
    """The converted folder of `data`, or of the bundled objects."""
    from conversion.convert import ConvertConfig, convert
    from mjcf_assets.generator import generate
    from vatmart_jax.data import BUNDLED_COUNT, BUNDLED_SEED, prepare

    def convert_into(source: Path, out: Path) -> None:
        say(f"converting {source} (what is up to date stays)")
        for failure in convert([source], out, ConvertConfig()).failed:
            say(f"refused {failure['id']}: {failure['reason']}")

    def make(out: Path) -> None:
        if not out.is_dir():
            say(f"making {BUNDLED_COUNT} bundled objects")
            part = out.with_name(out.name + ".part")
            generate(part, BUNDLED_COUNT, BUNDLED_SEED)
            part.rename(out)

    return prepare(data, convert_into, make)


def _enable_compilation_cache() -> None:
    """Compiled programs are kept between runs: it saves a minute or two of every run after the first."""
    import jax

    from vatmart_jax.data import cache_folder

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


if __name__ == "__main__":
    main()
