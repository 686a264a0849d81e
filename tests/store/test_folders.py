from datetime import datetime
from pathlib import Path

import pytest

from estbench.errors import StoreError
from estbench.store import folders
from estbench.store.folders import named, opened


@pytest.fixture
def one_second(tmp_path, monkeypatch):
    class Frozen(datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2026, 5, 4, 3, 2, 1, tzinfo=tz)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(folders, "datetime", Frozen)


@pytest.mark.parametrize("name", ["robot", "../../robot", "/etc/robot"])
def test_a_new_folder_lies_in_results_and_is_not_left_empty(name, one_second):
    with named(name) as folder:
        assert folder.parent == Path("results")
        assert folder.name.endswith("robot-20260504T030201")
        assert not folder.exists()
    assert not Path("results").exists()


def test_two_that_begin_in_one_second_have_two_folders(one_second):
    with named("robot") as first, named("robot") as second, named("other") as other:
        assert [first.name, second.name] == ["robot-20260504T030201", "robot-20260504T030201-2"]
        assert other.name == "other-20260504T030201"
        second.mkdir()
    with named("robot") as third, named("robot") as fourth:
        assert (third, fourth.name) == (first, "robot-20260504T030201-3")
    assert list(Path("results").iterdir()) == [second]


def test_results_that_cannot_be_written(one_second):
    Path("results").write_text("dear")
    with pytest.raises(StoreError, match=r"T030201 cannot be written: .*choose another --out"):
        named("robot").__enter__()


@pytest.mark.parametrize(
    ("there", "resume", "shared", "expected"),
    [
        ("never", False, False, "created"),
        ("never", True, True, "created"),
        ("empty", True, False, "created"),
        ("before", True, False, "reopened"),
        ("before", False, True, "reopened"),
        ("before", False, False, None),
        ("meanwhile", True, True, "reopened"),  # another process makes it at the same time
        ("meanwhile", True, False, None),
    ],
)
def test_a_store_is_made_or_gone_on_with(there, resume, shared, expected, tmp_path):
    def create():
        if there in ("never", "empty"):
            return "created"
        folder.mkdir(exist_ok=True)
        (folder / "scenario.toml").touch()
        raise StoreError("it exists")

    def made():
        return opened(folder, resume, shared, create, lambda: "reopened")

    folder = tmp_path / "x"
    if there in ("before", "empty"):
        folder.mkdir()
    if there == "before":
        (folder / "scenario.toml").touch()
    if expected is None:
        with pytest.raises(StoreError, match="it exists"):
            made()
    else:
        assert made() == expected
