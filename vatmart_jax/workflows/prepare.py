"""Data ready to train on or evaluate with: generated, converted and with enough points, made where it is not there."""

from __future__ import annotations

from pathlib import Path

from conversion.config import ConvertConfig, ViewConfig
from conversion.convert import convert
from conversion.readers import is_object
from mjcf_assets.procedural.generate import GENERATOR_VERSION, generate
from vatmart_jax.atomic_io import atomic_directory
from vatmart_jax.data.cache import WANTED, DataError, bundled_folder, converted_folder, is_converted
from vatmart_jax.errors import UserError
from vatmart_jax.pipeline.run_config import DataSource
from vatmart_jax.reporting import NullReporter, Reporter

BUNDLED_COUNT, BUNDLED_SEED = 50, 0


def prepare(data: Path | None, *, num_points: int = 0, reporter: Reporter | None = None) -> Path:
    """The converted folder of `data`, or of the bundled objects.

    data: a converted folder, which is returned as it is; a folder of PartNet-Mobility objects; None for the bundled
    ones. num_points: views that are made now have at least so many. Raises DataError where `data` is neither.
    """
    reporter = reporter or NullReporter()
    if data is not None and is_converted(data):
        return data
    if data is not None and (is_object(data) or not any(is_object(f) for f in data.iterdir() if f.is_dir())):
        raise DataError(f"{data}: holds neither scenes.npz nor object folders that a reader detects; {WANTED}")
    source = bundled_folder(GENERATOR_VERSION, BUNDLED_COUNT, BUNDLED_SEED) if data is None else data

    def make(out: Path) -> None:
        if data is None and not source.is_dir():
            reporter.info(f"making {BUNDLED_COUNT} bundled objects")
            with atomic_directory(source) as part:
                generate(part, BUNDLED_COUNT, BUNDLED_SEED)
        reporter.info(f"converting {source} (what is up to date stays)")
        config = ConvertConfig(view=ViewConfig(points=max(num_points, ViewConfig.points)))
        for failure in convert([source], out, config).failed:
            reporter.info(f"refused {failure['id']}: {failure['reason']}")

    return converted_folder(source, make, reporter.info)


def prepare_source(source: DataSource, *, where: str, num_points: int = 0, reporter: Reporter | None = None) -> Path:
    """The converted folder that the run `where` learned from. Raises UserError where that is not here."""
    if source.kind == "external":
        raise UserError(
            f"{where}: was trained on objects that are not part of this package; name a folder of objects with --data"
        )
    return prepare(None if source.path is None else Path(source.path), num_points=num_points, reporter=reporter)
