"""A polled folder returns a file once, when it no longer changes."""

import os

from balance_cli.cli.watching.folder import WatchedFolder


def write(path, text, seconds):
    path.write_text(text)
    os.utime(path, (seconds, seconds))


def test_a_file_is_returned_when_it_no_longer_changes(tmp_path):
    folder = WatchedFolder(tmp_path)
    write(tmp_path / "a.h5", "begun", 100)
    assert folder.poll() == ()
    write(tmp_path / "a.h5", "begun, continued", 101)
    assert folder.poll() == ()
    assert folder.has_changing_files()
    assert folder.poll() == (tmp_path / "a.h5",)


def test_a_file_that_is_done_returns_only_after_a_change(tmp_path):
    folder = WatchedFolder(tmp_path)
    write(tmp_path / "a.h5", "content", 100)
    folder.poll()
    assert folder.poll() == (tmp_path / "a.h5",)
    folder.mark_done(tmp_path / "a.h5")
    assert folder.poll() == ()
    assert not folder.has_changing_files()
    write(tmp_path / "a.h5", "content", 200)
    folder.poll()
    assert folder.poll() == (tmp_path / "a.h5",)


def test_a_change_while_a_file_is_examined_is_not_lost(tmp_path):
    folder = WatchedFolder(tmp_path)
    write(tmp_path / "a.h5", "first", 100)
    folder.poll()
    folder.poll()
    write(tmp_path / "a.h5", "second version", 101)
    folder.mark_done(tmp_path / "a.h5")
    folder.poll()
    assert folder.poll() == (tmp_path / "a.h5",)


def test_the_oldest_comes_first_and_other_files_do_not_count(tmp_path):
    folder = WatchedFolder(tmp_path)
    for name, seconds in (("b.h5", 100), ("a.hdf5", 200), (".part-1.h5", 50), ("notes.txt", 60)):
        write(tmp_path / name, "content", seconds)
    (tmp_path / "folder.h5").mkdir()
    folder.poll()
    assert [path.name for path in folder.poll()] == ["b.h5", "a.hdf5"]


def test_a_file_that_is_moved_away_is_forgotten(tmp_path):
    folder = WatchedFolder(tmp_path)
    write(tmp_path / "a.h5", "content", 100)
    folder.poll()
    (tmp_path / "a.h5").unlink()
    assert folder.poll() == ()
    assert not folder.has_changing_files()
