from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from protomark import files
from protomark.files import (
    check_folder,
    check_outputs,
    only_writer,
    replacing,
    replacing_folder,
    write_text,
)
from test_tracks_command import fails, run
from tracks_scene import write_sequence


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "eins\n")
    write_text(path, "zwölf\n")
    assert path.read_text(encoding="utf-8") == "zwölf\n"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_links_are_written_through_and_devices_stay(tmp_path: Path) -> None:
    (tmp_path / "v1.txt").write_text("old", encoding="utf-8")
    (tmp_path / "current.txt").symlink_to("v1.txt")
    write_text(tmp_path / "current.txt", "new")
    assert (tmp_path / "current.txt").is_symlink()
    assert (tmp_path / "v1.txt").read_text(encoding="utf-8") == "new"
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="not a regular file"):
        write_text(tmp_path / "pipe", "x")
    assert (tmp_path / "pipe").is_fifo()


def test_one_process_at_a_time_writes_to_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    with only_writer(folder):
        with pytest.raises(BlockingIOError, match=rf"folder: process {os.getpid()} on .* writing"):
            only_writer(folder).__enter__()
        with only_writer(folder, "one file"), only_writer(folder, "another"):
            pass
        (folder / "a").touch()
    assert os.listdir(folder) == ["a"]
    (folder / "a").unlink()
    (folder / ".lock").touch()  # of a process that was killed
    with only_writer(folder):
        pass
    folder.rmdir()
    with pytest.raises(ValueError), only_writer(folder):  # noqa: PT011, PT012
        assert folder.is_dir()
        raise ValueError
    assert not folder.exists()
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="file is not a folder"):
        only_writer(tmp_path / "file").__enter__()


def test_a_file_system_without_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_lock(*_: int) -> None:
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr("fcntl.flock", no_lock)
    with only_writer(tmp_path):
        pass
    assert os.listdir(tmp_path) == []


def test_commands_do_not_write_where_another_does(tmp_path: Path) -> None:
    sequence, out = write_sequence(tmp_path / "plane", count=2), tmp_path / "out"
    images = sequence / "images"
    with only_writer(out), only_writer(out, "plane.orb.safetensors"):
        for done in (
            run(images, "-o", out, "--camera", "PINHOLE:300,300,160,120", command="map"),
            run(tmp_path / "map.pmk", images, "-o", out, command="localize"),
            run(sequence, "-o", out, "-d", "orb"),
        ):
            fails(done, f"out: process {os.getpid()}", "wait for it, or name another folder")
    assert not out.exists()


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_leaves_what_was_there(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(error), replacing(path) as file:  # noqa: PT012
        file.write(b"half of the n")
        raise error
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.bin"]
    with pytest.raises(FileNotFoundError):
        write_text(tmp_path / "nowhere" / "a.txt", "x")


def test_a_new_file_is_as_readable_as_any(tmp_path: Path) -> None:
    old = os.umask(0o027)
    try:
        write_text(tmp_path / "a.txt", "x")
        os.umask(0o077)
        write_text(tmp_path / "b.txt", "x")
    finally:
        os.umask(old)
    modes = [(tmp_path / name).stat().st_mode & 0o777 for name in ("a.txt", "b.txt")]
    assert modes == [0o640, 0o600]


def test_a_file_that_is_replaced_keeps_its_permissions(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    for mode in (0o600, 0o664, 0o400):
        path.write_text("old", encoding="utf-8")
        path.chmod(mode)
        write_text(path, "new")
        assert path.stat().st_mode & 0o777 == mode
        assert path.read_text(encoding="utf-8") == "new"
        path.unlink()


def test_file_and_folder_are_synced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced = []
    monkeypatch.setattr(os, "fsync", lambda handle: synced.append(os.fstat(handle).st_ino))
    write_text(tmp_path / "a.txt", "x")
    assert synced == [(tmp_path / "a.txt").stat().st_ino, tmp_path.stat().st_ino]


@pytest.mark.skipif(not Path("/proc/version").exists(), reason="/proc is where nobody may write")
def test_a_folder_that_nobody_can_write_to_is_noticed_before_the_work(tmp_path: Path) -> None:
    check_folder(tmp_path / "new" / "folder")
    with pytest.raises(OSError, match="/proc: no file can be written"):
        check_folder(Path("/proc/new"))
    with pytest.raises(OSError, match="/proc: no file can be written"):
        check_outputs(Path("/proc/version"))
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="file is not a folder"):
        check_folder(tmp_path / "file" / "folder")
    assert os.listdir(tmp_path) == ["file"]


def test_maps_and_other_files_do_not_replace_each_other(tmp_path: Path) -> None:
    check_outputs(tmp_path / "facts.json", maps=[tmp_path / "scene.pmk", None])
    with pytest.raises(ValueError, match=r"photo.jpg: a map's file ends in .pmk: name another"):
        check_outputs(maps=[tmp_path / "photo.jpg"])
    with pytest.raises(ValueError, match=r"scene.pmk: only a map's file ends in .pmk"):
        check_outputs(tmp_path / "scene.pmk")


def test_a_folder_that_cannot_be_replaced_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, rename = tmp_path / "scene", Path.rename
    folder.mkdir()
    (folder / "old.txt").touch()

    def interrupted(self: Path, target: Path) -> Path:
        if self.name != "scene" and not self.name.endswith(".old"):
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(files, "_exchange", lambda *_: False)  # as on old kernels
    monkeypatch.setattr(Path, "rename", interrupted)
    with pytest.raises(KeyboardInterrupt), replacing_folder(folder):
        pass
    assert os.listdir(tmp_path) == ["scene"]
    assert os.listdir(folder) == ["old.txt"]


def test_folders_are_swapped_in_one_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kill between two renames would leave neither."""
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "old").touch()
    monkeypatch.setattr(Path, "rename", lambda *_: pytest.fail("two renames"))
    with replacing_folder(folder) as new:
        (new / "new").touch()
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]
    assert [path.name for path in folder.iterdir()] == ["new"]


def test_files_of_folders_that_are_read_are_not_replaced(tmp_path: Path) -> None:
    """A bag is a folder of recordings, and the files of a map belong together."""
    for name in ("bag", "kitchen", "hall"):
        (tmp_path / name).mkdir()
    recording = tmp_path / "bag" / "run_0.mcap"
    recording.write_bytes(b"x")
    with pytest.raises(ValueError, match="is part of an input of this command"):
        check_outputs(recording, inputs=[tmp_path / "bag"])
    (tmp_path / "kitchen" / "state.safetensors").write_bytes(b"x")
    kitchen, hall = tmp_path / "kitchen", tmp_path / "hall"
    for source, name in ((hall, "scene.pmk"), (hall, "part.pmk"), (kitchen, "scene.pmk")):
        with pytest.raises(ValueError, match="the folder of a map, whose files belong together"):
            check_outputs(maps=[kitchen / name], inputs=[source])
    check_outputs(maps=[kitchen / "scene.sealed.pmk"], inputs=[kitchen])
    check_outputs(maps=[kitchen / "part.pmk"], inputs=[kitchen / "scene.pmk"])
