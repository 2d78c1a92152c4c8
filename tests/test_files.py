import pytest

from vatmart_jax.atomic_io import whole, whole_folder


def test_a_file_is_there_complete_or_stays_as_it_was(tmp_path):
    path = tmp_path / "a.txt"
    with whole(path) as part:
        part.write_text("first")
        assert not path.exists()
    with pytest.raises(KeyboardInterrupt), whole(path) as part:
        part.write_text("sec")
        raise KeyboardInterrupt
    assert path.read_text() == "first" and list(tmp_path.iterdir()) == [path]


def test_a_folder_is_replaced_as_a_whole_or_stays_as_it_was(tmp_path):
    path = tmp_path / "new" / "folder"
    for name in ("first", "second"):
        with whole_folder(path) as part:
            (part / name).mkdir()
    with pytest.raises(KeyboardInterrupt), whole_folder(path) as part:
        (part / "third").mkdir()
        raise KeyboardInterrupt
    assert [p.name for p in path.iterdir()] == ["second"] and list(path.parent.iterdir()) == [path]


def test_what_a_killed_process_left_of_a_folder_is_cleared(tmp_path):
    (tmp_path / ".folder.part" / "half").mkdir(parents=True)
    with whole_folder(tmp_path / "folder"):
        pass
    assert not list((tmp_path / "folder").iterdir()) and len(list(tmp_path.iterdir())) == 1
