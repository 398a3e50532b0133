"""Atomic writing: the old file or the new one, complete, and a message that names the file."""

import os
import stat
from pathlib import Path

import pytest

from armctl import ArmctlError, InputError
from armctl.core.atomic import atomic_path, file_path, write_text


def fill(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        assert temporary.suffix == path.suffix
        temporary.write_text(text)


def fail_while_writing(path: Path, error: BaseException) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text("half")
        raise error


def test_a_file_is_replaced_and_nothing_else_is_left(tmp_path):
    path = tmp_path / "new" / "folder" / "a.txt"
    fill(path, "old")
    fill(path, "new")
    assert path.read_text() == "new"
    assert list(path.parent.iterdir()) == [path]
    write_text(path, "ü")
    assert path.read_bytes() == "ü".encode()


@pytest.mark.parametrize("error", [ValueError("x"), KeyboardInterrupt()], ids=["an error", "Ctrl-C"])
def test_the_old_file_stays_if_the_writer_fails(tmp_path, error):
    path = tmp_path / "a.txt"
    fill(path, "old")
    with pytest.raises(type(error)):
        fail_while_writing(path, error)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_of_the_disk_names_the_file(tmp_path):
    path = tmp_path / "a.txt"
    with pytest.raises(ArmctlError, match=r"a\.txt: cannot be written: No space left on device$"):
        fail_while_writing(path, OSError(28, "No space left on device"))
    (tmp_path / "folder.txt").mkdir()
    with pytest.raises(ArmctlError, match=r"folder\.txt: cannot be written: "):
        fill(tmp_path / "folder.txt", "x")
    assert {each.name for each in tmp_path.iterdir()} == {"folder.txt"}


@pytest.mark.skipif(os.name != "posix", reason="permissions, links and devices of POSIX")
def test_permissions_stay_links_are_followed_and_devices_are_written_directly(tmp_path):
    path = tmp_path / "a.txt"
    fill(path, "old")
    path.chmod(0o600)
    link = tmp_path / "link.txt"
    link.symlink_to(path)
    fill(link, "new")
    assert link.is_symlink()
    assert path.read_text() == "new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    pipe = tmp_path / "pipe.txt"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    fill(pipe, "through")
    assert os.read(reader, 100) == b"through"
    os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_the_ending_of_a_file_is_checked():
    assert file_path("path", "a/b.npz", (".npz", ".csv")) == Path("a/b.npz")
    with pytest.raises(InputError, match=r"^path: 'b.txt' ends in '.txt', expected .npz, .csv or .png$"):
        file_path("path", Path("a/b.txt"), (".npz", ".csv", ".png"))
    for wrong in (None, 3, b"a", "", "a\0b", ["a"], "\ud800"):
        with pytest.raises(InputError, match=r"^path: .* is not the name of a file$"):
            file_path("path", wrong)
