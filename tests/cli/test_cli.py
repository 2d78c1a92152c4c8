"""The command line: its contract, and one line for each kind of bad input."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from vatmart_jax import __version__
from vatmart_jax.cli.main import COMMANDS, main


@pytest.fixture(scope="module")
def generated(tmp_path_factory) -> Path:
    """One small object, made by the command."""
    out = tmp_path_factory.mktemp("objects") / "made"
    main(["generate", "--out", str(out), "--count", "5", "--seed", "3"])
    return out


@pytest.fixture
def cabinet(generated, tmp_path) -> Path:
    """A copy of one generated object, to damage."""
    source = sorted(p for p in generated.iterdir() if p.is_dir())[4]
    return Path(shutil.copytree(source, tmp_path / source.name))


def refused(capsys, *argv: str) -> str:
    """The one line on standard error of a command that must refuse."""
    with pytest.raises(SystemExit) as stopped:
        main(list(argv))
    printed = capsys.readouterr()
    assert stopped.value.code == 2
    lines = [line for line in printed.err.splitlines() if line.startswith("vatmart: error: ")]
    assert len(lines) == 1, printed.err
    return lines[0]


def refused_conversion(capsys, folder: Path) -> str:
    out = folder.parent / "out"
    line = refused(capsys, "convert", str(folder), "--out", str(out), "--jobs", "1")
    assert not out.exists() or not any(out.iterdir())
    return line


def edit(folder: Path, old: str, new: str) -> None:
    urdf = folder / "mobility.urdf"
    text = urdf.read_text()
    assert old in text
    urdf.write_text(text.replace(old, new, 1))


def meshes(folder: Path) -> list[Path]:
    return sorted((folder / "textured_objs").glob("*.obj"))


def test_help_and_version_name_every_command(capsys):
    main(["--version"])
    assert capsys.readouterr().out.strip() == __version__
    with pytest.raises(SystemExit) as stopped:
        main(["--help"])
    assert stopped.value.code == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_its_flags(command, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([command, "--help"])
    assert stopped.value.code == 0
    assert "--json" in capsys.readouterr().out


def test_generate_prints_json_last(tmp_path, capsys):
    main(["generate", "--out", str(tmp_path / "o"), "--count", "2", "--json"])
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["objects"] == 2 and result["seconds"] >= 0


def test_a_folder_without_urdf_is_refused(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert "mobility.urdf" in refused_conversion(capsys, tmp_path / "empty")


def test_a_urdf_that_is_not_xml_is_refused(cabinet, capsys):
    (cabinet / "mobility.urdf").write_text("not xml <")
    assert f"{cabinet.name}/mobility.urdf" in refused_conversion(capsys, cabinet)


def test_a_joint_without_limits_is_refused(cabinet, capsys):
    text = (cabinet / "mobility.urdf").read_text()
    start = text.index("<limit")
    (cabinet / "mobility.urdf").write_text(text[:start] + text[text.index("/>", start) + 2 :])
    line = refused_conversion(capsys, cabinet)
    assert "joint_" in line and "--continuous-range" in line


def test_a_missing_mesh_is_refused(cabinet, capsys):
    meshes(cabinet)[0].unlink()
    line = refused_conversion(capsys, cabinet)
    assert meshes(cabinet)[0].parent.name in line and "--allow-missing" in line


def test_a_mesh_path_that_leaves_the_folder_is_refused(cabinet, capsys):
    edit(cabinet, 'filename="textured_objs/', 'filename="../textured_objs/')
    assert "leaves" in refused_conversion(capsys, cabinet) or "outside" in refused_conversion(capsys, cabinet)


def test_an_empty_mesh_is_refused(cabinet, capsys):
    mesh = meshes(cabinet)[0]
    mesh.write_text("")
    assert mesh.name in refused_conversion(capsys, cabinet)


def test_an_unknown_task_is_refused(tmp_path, capsys):
    line = refused(capsys, "train", "--task", "lift-lid", "--out", str(tmp_path / "run"))
    assert "--task lift-lid: not one of push-door" in line
    assert not (tmp_path / "run").exists()


def test_an_unknown_preset_is_refused(tmp_path, capsys):
    line = refused(capsys, "train", "--task", "push-door", "--preset", "fast", "--out", str(tmp_path / "run"))
    assert "--preset fast: not one of quick, cpu, gpu, paper" in line


def test_data_that_is_no_data_is_refused(tmp_path, capsys):
    out = tmp_path / "run"
    nothing = str(tmp_path / "nothing")
    assert "no such folder" in refused(capsys, "train", "--task", "push-door", "--data", nothing, "--out", str(out))
    (tmp_path / "nothing").mkdir()
    assert "holds neither" in refused(capsys, "train", "--task", "push-door", "--data", nothing, "--out", str(out))
    assert not out.exists()


def test_more_data_adds_to_something(tmp_path, capsys):
    arguments = ("train", "--task", "push-door", "--more-data", str(tmp_path), "--out", str(tmp_path / "run"))
    assert "--more-data without --data" in refused(capsys, *arguments)
    assert not (tmp_path / "run").exists()


def test_a_damaged_bank_is_refused(tmp_path, capsys):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "scenes.npz").write_bytes(b"PK\x03\x04 cut")
    line = refused(
        capsys, "train", "--task", "push-door", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "r")
    )
    assert "scenes.npz: damaged" in line and "vatmart convert" in line


def test_an_output_folder_with_another_run_is_refused(tmp_path, capsys):
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text('{"format": 2, "task": "push-door", "seed": 7}')
    line = refused(capsys, "train", "--task", "push-door", "--out", str(run))
    assert "another config" in line and "choose another folder" in line
    assert sorted(p.name for p in run.iterdir()) == ["config.json"]


def test_evaluate_refuses_what_is_no_run(tmp_path, capsys):
    assert "no config.json" in refused(capsys, "evaluate", str(tmp_path))
    assert "--methods magic: not one of ours, priors, random" in refused(
        capsys, "evaluate", str(tmp_path), "--methods", "magic"
    )


def test_a_truncated_checkpoint_is_refused(tmp_path, capsys):
    from vatmart_jax.pipeline.presets import PRESETS
    from vatmart_jax.pipeline.run_config import DataSource, RunConfig

    config = RunConfig(
        task="push-door", data=DataSource.of(tmp_path), preset="quick", impl="c", seed=0, settings=PRESETS["quick"]
    )
    run = tmp_path / "run"
    (run / "priors").mkdir(parents=True)
    (run / "config.json").write_text(json.dumps(config.to_json()))
    (run / "priors" / "config.json").write_text("{")
    assert "priors/config.json" in refused(capsys, "evaluate", str(run))


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--metrics", "speed"), "--metrics speed: not one of priors, downstream, policy"),
        (("--impl", "sapien"), "--impl sapien: not one of c, warp, jax"),
        (("--trials", "0"), "--trials 0: must be at least 1"),
    ],
)
def test_unknown_names_are_refused_with_the_known_ones(flags, message, capsys):
    assert message in refused(capsys, "evaluate", "push-door", *flags)


def test_an_unknown_physics_is_refused_before_anything_is_written(tmp_path, capsys):
    run = tmp_path / "run"
    line = refused(capsys, "train", "--task", "push-door", "--impl", "sapien", "--out", str(run))
    assert "--impl sapien: not one of c, warp, jax" in line and not run.exists()


def test_pretrained_sets_of_unknown_objects_want_data(capsys):
    assert "push-door: was trained on objects that are not part" in refused(capsys, "evaluate", "push-door")


def test_a_reader_that_has_seen_enough_is_no_error():
    command = [sys.executable, "-m", "vatmart_jax.cli", "train", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""


def test_the_help_of_all_commands_imports_nothing_heavy():
    code = "import sys; from vatmart_jax.cli.main import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
    code += "print(sorted({'jax', 'numpy', 'mujoco', 'tyro', 'rich'} & set(sys.modules)))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.splitlines()[-1] == "[]"


def test_a_plugin_that_cannot_be_loaded_is_one_line(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("VATMART_PLUGINS", str(tmp_path / "missing.py"))
    assert "missing.py" in refused(capsys, "generate", "--out", str(tmp_path / "o"))
