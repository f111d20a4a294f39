"""Which images a folder holds, and images that cameras and copies make in odd ways."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from protomark.features.extractor import Extractor
from protomark.features.images import describe_folder, image_names, read_gray
from protomark.mapping.source import EXIF, ImageFolder
from tracks_scene import texture


def encoded(suffix: str, image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(suffix, image)[1])


def test_links_are_followed_and_hidden_files_are_not_taken(tmp_path: Path) -> None:
    folder, elsewhere = tmp_path / "scene", tmp_path / "elsewhere"
    for path in (folder / "@eaDir", folder / ".trash", folder / "Depth_maps", elsewhere):
        path.mkdir(parents=True)
    for name in ("10.jpg", "9.jpg", "1²3.JPE", "._9.jpg", "@eaDir/a.jpg", ".trash/a.jpg", "a.heic"):
        (folder / name).touch()
    (elsewhere / "b.png").touch()
    (folder / "Depth_maps" / "9.png").touch()
    (folder / "linked").symlink_to(elsewhere)
    (folder / "circle").symlink_to(folder)
    with open(os.fsencode(folder) + b"/caf\xe9.jpg", "wb"):
        pass
    (folder / "other").symlink_to(elsewhere)
    for output in ("kitchen/scene.pmk", "kitchen/views/a.png", "demo/protomark_demo.png"):
        (folder / output).parent.mkdir(parents=True, exist_ok=True)
        (folder / output).touch()
    assert image_names(folder) == ["1²3.JPE", "9.jpg", "10.jpg", "linked/b.png"]
    several, twice, left_out = describe_folder(folder)
    assert several == f"{folder}: 4 images of 2 folders"
    assert twice == f"{folder}: images that links name twice are taken once: 1"
    assert "1 heic" in left_out
    assert "1 whose name is not UTF-8 (caf" in left_out
    for name in ("Depth_maps", "kitchen", "demo"):
        assert f"1 folder {name}/" in left_out
    assert image_names(folder / "Depth_maps") == ["9.png"]  # who names it wants it
    assert image_names(folder / "demo") == ["protomark_demo.png"]
    assert describe_folder(elsewhere) == []


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_only_what_lacks_its_end_is_truncated(tmp_path: Path, suffix: str) -> None:
    path, data = tmp_path / f"a{suffix}", encoded(suffix, texture(200))
    path.write_bytes(data)
    expected = read_gray(path)
    if suffix == ".jpg":  # with a thumbnail in front, which has an end marker of its own
        thumbnail = b"\xff\xe1" + struct.pack(">H", 12) + b"Exif\0\0\xff\xd8\xff\xd9"
        data = data[:2] + thumbnail + data[2:]
    path.write_bytes(data + bytes(8000))  # as phones append videos
    np.testing.assert_array_equal(read_gray(path), expected)
    path.write_bytes(data[:-500])
    with pytest.raises(ValueError, match="truncated"):
        read_gray(path)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_all_bits_that_16_bit_images_use_count(tmp_path: Path, bits: int) -> None:
    image = texture(64)
    image[0] = 255
    cv2.imwrite(str(tmp_path / "a.png"), image.astype(np.uint16) << (bits - 8))
    np.testing.assert_array_equal(read_gray(tmp_path / "a.png"), image)


def test_what_opencv_refuses_is_named(tmp_path: Path) -> None:
    size = 50_000
    header = struct.pack(">IIBBBBB", size, size, 8, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(bytes(99))), (b"IEND", b"")]
    data = b"\x89PNG\r\n\x1a\n"
    for name, content in chunks:
        checksum = struct.pack(">I", zlib.crc32(name + content))
        data += struct.pack(">I", len(content)) + name + content + checksum
    (tmp_path / "huge.png").write_bytes(data)
    with pytest.raises(ValueError, match=r"huge\.png.*cannot decode"):
        read_gray(tmp_path / "huge.png")
    with pytest.raises(ValueError, match="no freak features of 2x3 pixels"):
        Extractor("freak")(np.zeros((3, 2), np.uint8))


def test_an_overwritten_opencv_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(cv2, "xfeatures2d")
    monkeypatch.delattr(cv2, "BRISK_create", raising=False)
    assert len(Extractor("orb")(texture(200)))
    with pytest.raises(ModuleNotFoundError, match=r"no BRISK_create.*uninstall all of them"):
        Extractor("freak")


def test_exif_data_are_those_of_the_first_image_that_can_be_read(tmp_path: Path) -> None:
    from PIL import Image

    exif = Image.Exif()
    exif[0x8769] = {0xA405: 34}  # focal length of 35 mm film
    Image.fromarray(texture(320)).save(tmp_path / "2.jpg", exif=exif)
    cv2.imwrite(str(tmp_path / "1.jpg"), texture(64))  # of another size
    Image.fromarray(texture(320)).save(tmp_path / "3.jpg", exif=exif)
    for name in ("0.jpg", "._1.jpg"):
        (tmp_path / name).write_bytes(b"")
    camera, origin = ImageFolder(tmp_path).guess_camera()
    assert origin == EXIF
    assert camera.params[0] == pytest.approx(34 / 43.27 * np.hypot(320, 320), rel=0.02)


def test_the_most_frequent_size_is_that_of_the_folder(tmp_path: Path) -> None:
    for i, size in enumerate((20, 20, 40, 40, 40)):
        cv2.imwrite(str(tmp_path / f"{i}.png"), texture(size))
    (tmp_path / "00.png").write_bytes(b"")
    folder = ImageFolder(tmp_path)
    assert folder.size() == (40, 40)
