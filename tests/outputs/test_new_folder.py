import json
from pathlib import Path

import pytest

from soundmap.errors import OutputError
from soundmap.outputs.new_folder import new_folder


def write_run_folder(folder: Path, *, force: bool = False, content: str = "new") -> None:
    with new_folder(folder, force=force) as partial:
        (partial / "report.json").write_text(json.dumps({"soundmap": "1"}))
        (partial / "content").write_text(content)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_folder_appears_with_its_parents_once_all_is_written(tmp_path):
    folder = tmp_path / "results" / "monday" / "run1"
    with new_folder(folder, force=False) as partial:
        (partial / "content").write_text("new")
        assert not folder.exists()
    assert (folder / "content").read_text() == "new"
    assert names(folder.parent) == ["run1"]


@pytest.mark.parametrize("stop", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_nothing_is_left_when_the_work_stops_half_way(tmp_path, stop):
    def half_done():
        with new_folder(tmp_path / "new" / "run1", force=False) as partial:
            (partial / "content").write_text("half")
            raise stop

    with pytest.raises(stop):
        half_done()
    assert names(tmp_path) == []


def test_an_empty_folder_is_filled(tmp_path):
    (tmp_path / "run1").mkdir()
    write_run_folder(tmp_path / "run1")
    assert names(tmp_path / "run1") == ["content", "report.json"]


def test_a_folder_with_content_is_refused_before_the_work(tmp_path):
    write_run_folder(tmp_path / "run1", content="old")
    with (
        pytest.raises(OutputError, match=r"not empty.*--force"),
        new_folder(tmp_path / "run1", force=False),
    ):
        pytest.fail("the work was begun")
    assert (tmp_path / "run1" / "content").read_text() == "old"


def test_force_replaces_an_earlier_run_only_once_the_new_one_is_complete(tmp_path):
    write_run_folder(tmp_path / "run1", content="old")
    (tmp_path / "run1" / "stale").touch()
    with pytest.raises(ValueError, match="broken"), new_folder(tmp_path / "run1", force=True):
        raise ValueError("broken")
    assert (tmp_path / "run1" / "content").read_text() == "old"
    write_run_folder(tmp_path / "run1", force=True)
    assert (tmp_path / "run1" / "content").read_text() == "new"
    assert names(tmp_path / "run1") == ["content", "report.json"]
    assert names(tmp_path) == ["run1"]


@pytest.mark.parametrize("report", [None, "not JSON", "[]", '{"coverage": 1}'])
def test_a_folder_of_something_else_is_never_replaced(tmp_path, report):
    folder = tmp_path / "thesis"
    folder.mkdir()
    (folder / "chapter1").write_text("years of work")
    if report is not None:
        (folder / "report.json").write_text(report)
    with pytest.raises(OutputError, match="not replaced even with --force"):
        write_run_folder(folder, force=True)
    assert (folder / "chapter1").read_text() == "years of work"


def test_a_folder_that_holds_the_log_is_not_replaced(tmp_path):
    write_run_folder(tmp_path / "run1")
    log = tmp_path / "run1" / "run1.mcap"
    log.touch()
    with (
        pytest.raises(OutputError, match=r"run1\.mcap, which is being read"),
        new_folder(tmp_path / "run1", force=True, inputs=[log]),
    ):
        pytest.fail("the work was begun")
    assert log.exists()


def test_a_folder_filled_by_someone_else_in_the_meantime_is_kept(tmp_path):
    def overtaken():
        with new_folder(tmp_path / "run1", force=False) as partial:
            (partial / "content").write_text("mine")
            (tmp_path / "run1").mkdir()
            (tmp_path / "run1" / "content").write_text("theirs")

    with pytest.raises(OutputError, match="not empty"):
        overtaken()
    assert (tmp_path / "run1" / "content").read_text() == "theirs"
    assert names(tmp_path) == ["run1"]


@pytest.mark.parametrize("folder", ["file", "file/run1", "file/deep/run1"])
def test_a_file_in_the_way_is_named(tmp_path, folder):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="file is a file"):
        write_run_folder(tmp_path / folder)


def test_a_name_too_long_for_the_disk_leaves_nothing_behind(tmp_path):
    with (
        pytest.raises(OutputError, match="File name too long"),
        new_folder(tmp_path / ("n" * 245), force=False),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_the_working_folder_is_not_pulled_away_from_under_the_user(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for folder in (Path(), tmp_path):
        with pytest.raises(OutputError, match="in use as the working folder"):
            write_run_folder(folder)


def test_a_parent_that_cannot_be_written_is_found_before_the_work(tmp_path, monkeypatch):
    def refuse(self, *_args, **_keywords):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with (
        pytest.raises(OutputError, match=r"cannot be written.*Permission denied.*--out"),
        new_folder(tmp_path / "run1", force=False),
    ):
        pytest.fail("the work was begun")


def test_the_old_folder_comes_back_when_the_last_renaming_fails(tmp_path, monkeypatch):
    write_run_folder(tmp_path / "run1", content="old")
    rename = Path.rename

    def once_refused(self, target):
        if ".partial-" in self.name:
            raise OSError(28, "No space left on device")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", once_refused)
    with pytest.raises(OutputError, match="No space left"):
        write_run_folder(tmp_path / "run1", force=True)
    assert (tmp_path / "run1" / "content").read_text() == "old"
    assert names(tmp_path) == ["run1"]


def test_a_link_to_a_folder_stays_a_link(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "run1").symlink_to(tmp_path / "disk")
    write_run_folder(tmp_path / "run1")
    assert (tmp_path / "run1").is_symlink()
    assert names(tmp_path / "disk") == ["content", "report.json"]


def test_what_a_killed_run_left_is_tidied_up_and_what_a_living_one_writes_is_not(tmp_path):
    left = tmp_path / ".run1.partial-0123abcd"
    left.mkdir()
    (left / "content").write_text("half")
    others = tmp_path / ".run10.partial-0123abcd"
    others.mkdir()

    def outrun():
        with new_folder(tmp_path / "run1", force=False) as partial:
            assert not left.exists()
            (partial / "content").write_text("mine")
            write_run_folder(tmp_path / "run1", content="theirs")
            assert (partial / "content").read_text() == "mine"

    with pytest.raises(OutputError, match="not empty"):
        outrun()
    assert (tmp_path / "run1" / "content").read_text() == "theirs"
    assert names(tmp_path) == [others.name, "run1"]


def test_a_run_that_was_about_to_be_replaced_when_the_process_was_killed_comes_back(tmp_path):
    old = tmp_path / ".run.old-0123abcd"
    old.mkdir()
    (old / "report.json").write_text('{"soundmap": "0.1"}')
    with pytest.raises(OutputError, match="not empty"), new_folder(tmp_path / "run", force=False):
        pass
    assert (tmp_path / "run" / "report.json").exists()
    assert not old.exists()
