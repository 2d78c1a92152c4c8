"""The `vatmart` command. Progress and logs go to standard error; `--json` prints one object on standard output."""

# No postponed annotations here: tyro reads those of the commands' dataclasses, which only their functions see.
import json
import os
import sys
from collections.abc import Callable
from ctypes.util import find_library
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional, arg

from vatmart_jax import __version__
from vatmart_jax.atomic_io import atomic_directory, write_json
from vatmart_jax.errors import OpenGLError, UserError, require_one_of
from vatmart_jax.registry import load_plugins

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
        load_plugins()
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
    from conversion.command import Convert

    args = tyro.cli(Convert, args=argv, prog="vatmart convert")
    _print_result(args.run(), args.json)


def _generate(argv: list[str]) -> None:
    """Make objects in PartNet-Mobility's layout: procedural ones, or stretched copies of others."""
    from mjcf_assets.command import Generate

    args = tyro.cli(Generate, args=argv, prog="vatmart generate")
    _print_result(args.run(), args.json)


def _train(argv: list[str]) -> None:
    """Train priors for one task: all stages, resumable."""
    from vatmart_jax.pipeline.presets import PRESETS, Settings, default_preset

    chosen = _peek(argv, "--preset") or default_preset(_peek(argv, "--data") is not None)
    require_one_of("--preset", chosen, PRESETS)

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
        more_data: tuple[Path, ...] = ()
        """further folders such as those of `vatmart generate`, whose training splits are trained on too"""
        preset: str = chosen
        """quick, cpu, gpu or paper; the flags below start from it; default quick for the bundled objects, and with
        --data gpu on a GPU, else cpu"""
        impl: str | None = None
        """physics: c, warp or jax; default warp on an NVIDIA GPU, else c"""
        seed: int = 0
        json: _Json = False
        settings: Annotated[Settings, arg(name="")] = field(default_factory=lambda: PRESETS[chosen])

    args = tyro.cli(Train, args=argv, prog="vatmart train")
    _enable_compilation_cache()
    from vatmart_jax.data.dataset import Data
    from vatmart_jax.physics import default_impl
    from vatmart_jax.pipeline.run_dir import check_folder
    from vatmart_jax.reporting import ConsoleReporter
    from vatmart_jax.workflows.train import resolve, train

    if args.more_data and args.data is None:
        raise UserError("--more-data without --data: name what it adds to")
    config = resolve(
        args.task, args.preset, args.impl or default_impl(), args.seed, args.settings, args.data, args.more_data
    )
    check_folder(args.out, config)
    with ConsoleReporter() as reporter:
        points = args.settings.perception.networks.encoder.n_points
        data = Data(*(_prepared(folder, reporter.info, points) for folder in (args.data, *args.more_data)))
        result, table = train(config, args.settings, data, args.out, reporter)
    _print_result(result, args.json, table)


def _evaluate(argv: list[str]) -> None:
    """Evaluate trained priors: success rates and the priors' metrics."""

    @dataclass(frozen=True)
    class Evaluate:
        """Evaluate trained priors on test shapes and unseen categories."""

        run: Positional[tuple[Path, ...]]
        """run folders of `vatmart train`, or names of pretrained priors, such as push-door"""
        data: Path | None = None
        """default: the data that the run was trained on"""
        metrics: str = "priors,downstream"
        """priors (accuracy, coverage), downstream (success), policy (on training objects); several with commas"""
        methods: str = "ours,random"
        """of downstream: ours, random, expert (a script that knows the joint: the ceiling)"""
        trials: int = 350
        """per method and split"""
        impl: str | None = None
        """physics; default as for training"""
        seed: int = 1
        out: Path | None = None
        """folder for evaluation.json, evaluation.md and reliability.png; default the run folder"""
        json: _Json = False

    args = tyro.cli(Evaluate, args=argv, prog="vatmart evaluate")
    if not args.run:
        raise UserError("no run; give one or more run folders of `vatmart train`")
    _enable_compilation_cache()
    from vatmart_jax.physics import default_impl
    from vatmart_jax.reporting import ConsoleReporter
    from vatmart_jax.workflows.evaluate import evaluate

    with ConsoleReporter() as reporter:
        result, table = evaluate(
            args.run,
            lambda data: _prepared(data, reporter.info),
            args.data,
            tuple(args.metrics.split(",")),
            tuple(args.methods.split(",")),
            args.trials,
            args.impl or default_impl(),
            args.seed,
            args.out,
            reporter,
        )
    _print_result(result, args.json, table)


def _play(argv: list[str]) -> None:
    """Show one trial as an animated picture, or in MuJoCo's viewer."""

    @dataclass(frozen=True)
    class Play:
        """Show one trial: the scripted expert's, what a run's priors propose, or a trajectory from a file."""

        scene: Positional[str]
        """object id, id:part, or index into the data's Scenes"""
        data: Path | None = None
        """a folder of objects, or what `vatmart convert` made of it; default the run's data, or the bundled objects"""
        task: str | None = None
        """default the run's, or to push"""
        amount: float | None = None
        """how far to move the part, rad or unit lengths; default random"""
        run: Path | None = None
        """a run folder of `vatmart train`, or the name of pretrained priors: their best proposal"""
        trajectory: Path | None = None
        """a .npy file of 30 numbers: 6D rotation of the start pose, then four residual waypoints"""
        contact: tuple[float, float, float] | None = None
        """with --trajectory: touch the part nearest to this point; default a random one"""
        out: Path = Path("play.gif")
        viewer: bool = False
        """MuJoCo's viewer instead of a picture"""
        seed: int = 0
        json: _Json = False

    args = tyro.cli(Play, args=argv, prog="vatmart play")
    if args.run and args.trajectory:
        raise UserError("--run and --trajectory: give one of them")
    if sys.platform == "linux" and not args.viewer:
        # MuJoCo reads it when it is imported.
        os.environ.setdefault("MUJOCO_GL", "egl" if find_library("EGL") else "osmesa")
    try:
        import mujoco  # noqa: F401
    except (ImportError, AttributeError) as e:  # what PyOpenGL raises where the library is missing
        raise OpenGLError from e
    _enable_compilation_cache()
    from vatmart_jax.pipeline.run_dir import read_config
    from vatmart_jax.priors.pretrained import run_folder
    from vatmart_jax.reporting import ConsoleReporter
    from vatmart_jax.viz.trial_video import animate, play, show

    run = run_folder(args.run) if args.run else None
    of_run = read_config(run)["data"] if run else None
    with ConsoleReporter() as reporter:
        folder = _prepared(args.data or (Path(of_run) if of_run else None), reporter.info)
    recording, result = play(folder, args.scene, args.task, args.amount, args.trajectory, args.contact, run, args.seed)
    if args.viewer:
        show(recording)
    else:
        animate(recording, args.out)
        result["file"] = str(args.out)
    _print_result(result, args.json)


def _bench(argv: list[str]) -> None:
    """Measure speed and agreement: bench physics, parity or perception."""
    what = argv[0] if argv else ""
    if what in ("-h", "--help"):
        rows = "\n".join(f"  {name:<10} {(kind.__doc__ or '').strip()}" for name, kind in _BENCHES.items())
        flags = "`vatmart bench WHAT --help` lists the flags of one, --json among them."
        print(f"usage: vatmart bench WHAT [flags]\n\n{rows}\n\n{flags}")
        sys.exit(0)
    if what not in _BENCHES:
        raise UserError(f"bench {what}: say what to measure, one of {', '.join(_BENCHES)}")
    args = tyro.cli(_BENCHES[what], args=argv[1:], prog=f"vatmart bench {what}")
    _enable_compilation_cache()
    from vatmart_jax.bench.benchmarks import Choice
    from vatmart_jax.reporting import ConsoleReporter

    if len(args.data) > (2 if what == "parity" else 1):
        raise UserError(f"--data: {len(args.data)} folders; give one (parity: or two conversions of the same objects)")
    with ConsoleReporter() as reporter:
        folders = [_prepared(data, reporter.info) for data in args.data or (None,)]
        result = args.run(Choice(folders[0], args.split, args.objects), folders[1:], reporter.info)
    if args.out:
        write_json(args.out, result)
    _print_result(result, args.json)


@dataclass(frozen=True)
class _Bench:
    data: tuple[Path, ...] = ()
    """a folder of objects, or what `vatmart convert` made of it; default the bundled objects"""
    split: str = "train"
    """train, test_shapes, test_categories, extra or all"""
    objects: int | None = None
    """only so many of its objects, drawn at random"""
    seed: int = 0
    out: Path | None = None
    """also write the result to this .json file"""
    json: _Json = False


@dataclass(frozen=True)
class _BenchPhysics(_Bench):
    """Physics steps and whole trials per second."""

    impl: str = "c"
    """c, warp or jax"""
    batch: str = "1024"
    """simulations at once; several as in 256,1024,4096"""
    task: str = "push-door"
    seconds: float = 10.0
    """each measurement lasts at least so long"""

    def run(self, choice: Any, others: list[Path], say: Callable[[str], None]) -> dict[str, Any]:
        from vatmart_jax.bench.benchmarks import bench_physics

        try:
            batches = tuple(int(word) for word in self.batch.split(","))
        except ValueError as e:
            raise UserError(f"--batch {self.batch}: expected whole numbers, as in 256,1024,4096") from e
        return bench_physics(choice, self.impl, batches, self.task, self.seed, self.seconds)


@dataclass(frozen=True)
class _BenchParity(_Bench):
    """The same random trials on several implementations; with a second --data folder (boxes) also on that."""

    impls: str = "c,warp,jax"
    """the first is the reference"""
    trials: int = 120
    """per task"""

    def run(self, choice: Any, others: list[Path], say: Callable[[str], None]) -> dict[str, Any]:
        from vatmart_jax.bench.benchmarks import bench_parity

        twin = others[0] if others else None
        return bench_parity(choice, tuple(self.impls.split(",")), self.trials, self.seed, twin, say)


@dataclass(frozen=True)
class _BenchPerception(_Bench):
    """Training steps per second, and how long a view of 10,000 points takes to encode."""

    preset: str = "cpu"
    """whose networks: quick, cpu, gpu or paper"""
    seconds: float = 10.0
    """each measurement lasts at least so long"""

    def run(self, choice: Any, others: list[Path], say: Callable[[str], None]) -> dict[str, Any]:
        from vatmart_jax.bench.benchmarks import bench_perception

        return bench_perception(choice, self.preset, self.seed, self.seconds)


_BENCHES: dict[str, Any] = {"physics": _BenchPhysics, "parity": _BenchParity, "perception": _BenchPerception}


def _predict(argv: list[str]) -> None:
    """Ask trained priors about a point cloud."""

    @dataclass(frozen=True)
    class Predict:
        """Where to touch a partial point cloud for a task, which trajectories to try, and how likely each works."""

        priors: Positional[Path]
        """run folder of `vatmart train`, a folder of priors, or the name of pretrained ones, such as push-door"""
        cloud: Path
        """.npy [N, 3] or .ply: z up, the object's front towards -x, unit lengths"""
        task: str
        """how far to move the part: 30deg or 0.5rad (doors), 0.3 (drawers, unit lengths)"""
        mask: Path | None = None
        """.npy [N] bool: the points of the part to move"""
        proposals: int = 100
        seed: int = 0
        out: Path | None = None
        """.npz for the actionability of every point, all trajectories and their scores"""
        json: _Json = False

    args = tyro.cli(Predict, args=argv, prog="vatmart predict")
    _enable_compilation_cache()
    from vatmart_jax.cli.inputs import parse_goal, read_cloud, read_mask
    from vatmart_jax.priors.pretrained import run_folder
    from vatmart_jax.priors.priors import Priors

    priors = Priors.load(run_folder(args.priors))
    points = read_cloud(args.cloud)
    mask = None if args.mask is None else read_mask(args.mask, len(points))
    import jax

    key, task = jax.random.key(args.seed), parse_goal(args.task, priors.config.task)
    found = priors.predict(points, task, mask, key, args.proposals)
    if args.out is not None:
        found.save(args.out)
    result = {
        "contact": found.contact.tolist(),
        "contact_index": found.contact_index,
        "actionability_max": float(found.actionability[found.contact_index]),
        "trajectories": found.trajectories.tolist(),
        "scores": found.scores.tolist(),
    }
    table = (
        f"contact {', '.join(f'{x:.3f}' for x in found.contact)}  actionability {result['actionability_max']:.3f}  "
        f"best score {found.scores[0]:.3f}"
    )
    _print_result(result, args.json, "" if args.json else table)


def _export(argv: list[str]) -> None:
    """Write a run's priors so that they stand alone: Flax, StableHLO."""

    @dataclass(frozen=True)
    class Export:
        """Write the priors of a run into a folder that needs nothing else."""

        run: Positional[Path]
        """run folder of `vatmart train`, a folder of priors, or the name of pretrained ones, such as push-door"""
        out: Path
        format: str = "flax,stablehlo"
        """flax (loads with Priors.load), stablehlo (loads with jax.export.deserialize), or both"""
        proposals: int = 100
        """trajectories that the StableHLO function returns"""
        json: _Json = False

    args = tyro.cli(Export, args=argv, prog="vatmart export")
    from vatmart_jax.priors.export import export
    from vatmart_jax.priors.pretrained import run_folder
    from vatmart_jax.priors.priors import Priors

    files = export(Priors.load(run_folder(args.run)), args.out, tuple(args.format.split(",")), args.proposals)
    _print_result({"files": [str(f) for f in files]}, args.json)


COMMANDS: dict[str, Callable[[list[str]], None]] = {
    "convert": _convert,
    "generate": _generate,
    "train": _train,
    "evaluate": _evaluate,
    "predict": _predict,
    "export": _export,
    "play": _play,
    "bench": _bench,
}


def _peek(argv: list[str], flag: str) -> str | None:
    """The value of a flag that decides the defaults of others."""
    for i, word in enumerate(argv):
        if word == flag and i + 1 < len(argv):
            return argv[i + 1]
        if word.startswith(flag + "="):
            return word.split("=", 1)[1]
    return None


def _prepared(data: Path | None, say: Callable[[str], None], points: int = 0) -> Path:
    """The converted folder of `data`, or of the bundled objects; views made now have at least so many points."""
    from conversion.config import ConvertConfig, ViewConfig
    from conversion.convert import convert
    from mjcf_assets.procedural.generate import generate
    from vatmart_jax.data.dataset import BUNDLED_COUNT, BUNDLED_SEED, prepare

    def convert_into(source: Path, out: Path) -> None:
        say(f"converting {source} (what is up to date stays)")
        config = ConvertConfig(view=ViewConfig(points=max(points, ViewConfig.points)))
        for failure in convert([source], out, config).failed:
            say(f"refused {failure['id']}: {failure['reason']}")

    def make(out: Path) -> None:
        if not out.is_dir():
            say(f"making {BUNDLED_COUNT} bundled objects")
            with atomic_directory(out) as part:
                generate(part, BUNDLED_COUNT, BUNDLED_SEED)

    return prepare(data, convert_into, make, say)


def _enable_compilation_cache() -> None:
    """Compiled programs are kept between runs: it saves a minute or two of every run after the first."""
    import jax

    from vatmart_jax.data.dataset import cache_folder

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
