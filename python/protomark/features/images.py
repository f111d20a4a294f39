"""Lists and reads images."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.files import SCENE_MAP, is_utf8, natural_key

# Folders below a folder of images that, by their names, hold no images of the scene.
_OTHER_FOLDERS = re.compile(
    r"(depth|mask|normal|semantic|segmentation|thumb(nail)?)s?(_?(map|image)s?)?", re.IGNORECASE
)
# Files of folders that commands wrote, whose pictures are none of the scene.
_OUTPUTS = {SCENE_MAP, "protomark_demo.png"}
IMAGE_SUFFIXES = (
    *(".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff"),
    *(".bmp", ".ppm", ".pgm", ".webp"),
)


def image_names(folder: Path) -> list[str]:
    """Names of the images below a folder, relative to it, in natural order (img2 before img10).

    Links are followed, and an image that several lead to counts once. Hidden files and folders,
    those of storage servers (@eaDir), of depth maps or masks and of maps do not count, and neither
    do names that are not UTF-8.
    """
    names = sorted(filter(_is_image, _file_names(folder)), key=natural_key)
    by_file: dict[object, str] = {}
    for name in names:
        by_file.setdefault(file_identity(folder / name) or name, name)
    return list(by_file.values())


def describe_folder(folder: Path) -> list[str]:
    """Sentences on what below a folder `image_names` takes and leaves out, if it is not all."""
    files, names = list(_file_names(folder)), image_names(folder)
    out = []
    if len(folders := {Path(name).parent for name in names}) > 1:
        out.append(f"{folder}: {len(names)} images of {len(folders)} folders")
    if twice := sum(map(_is_image, files)) - len(names):
        out.append(f"{folder}: images that links name twice are taken once: {twice}")
    if kinds := Counter(_kind(name) for name in files if not _is_image(name)):
        listed = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common(5))
        out.append(f"{folder}: files that are no images are passed over: {listed}")
    return out


def file_identity(path: Path) -> tuple[int, int] | None:
    """What tells files apart, whatever their names; None if the file system does not say."""
    try:
        found = path.stat()
    except OSError:
        return None
    return (found.st_dev, found.st_ino) if found.st_ino else None


def _file_names(folder: Path) -> Iterator[str]:
    for here, folders, files in os.walk(folder, followlinks=True):
        below = Path(here)
        name = below.relative_to(folder).as_posix() + "/"
        if below != folder and (_OTHER_FOLDERS.fullmatch(below.name) or _OUTPUTS & {*files}):
            yield name
            folders.clear()
            continue
        folders[:] = [f for f in folders if f[0] not in ".@" and not _is_circle(below / f)]
        yield from ((below / f).relative_to(folder).as_posix() for f in files if f[0] not in ".@")


def _is_circle(folder: Path) -> bool:
    return folder.is_symlink() and folder.resolve() in (p.resolve() for p in folder.parents)


def _is_image(name: str) -> bool:
    return is_utf8(name) and name.lower().endswith(IMAGE_SUFFIXES)


def _kind(name: str) -> str:
    if not is_utf8(name):
        return f"whose name is not UTF-8 ({name})"
    if name.endswith("/"):
        return f"folder {name}"
    return Path(name).suffix[1:].lower() or "without a suffix"


def read_gray(path: Path) -> NDArray[np.uint8]:
    """Read an image as (height, width) uint8, exactly as stored (not rotated by EXIF).

    Of 16 bits per pixel the upper 8 of those that the image uses are kept, as cameras store 10 or
    12 bits in 16.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not an image, or it is truncated.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such image")
    return decode_gray(np.fromfile(path, dtype=np.uint8), str(path))


def decode_gray(data: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    """Decode the bytes (n,) of an image file as `read_gray` does; errors begin with the name.

    Raises:
        ValueError: the bytes are no image, or a truncated one.
    """
    cv2 = optional("cv2")
    # OpenCV fills the missing rows of a truncated image with grey and only warns.
    if _is_truncated(data.tobytes()):
        raise ValueError(f"{name}: the image is truncated (no end marker), copy it anew")
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(data, flags | cv2.IMREAD_ANYDEPTH) if len(data) else None
        if image is not None and image.dtype not in (np.uint8, np.uint16):
            image = cv2.imdecode(data, flags)
    except cv2.error as error:
        raise ValueError(f"{name}: OpenCV cannot decode this image ({error.err})") from None
    if image is None:
        raise ValueError(
            f"{name}: the image is truncated, or its format is unknown: copy it anew, or convert it"
        )
    return to_8_bits(image)


def to_8_bits(image: NDArray[Any]) -> NDArray[np.uint8]:
    """An image of 8 bits, or of 16, of which the upper 8 of those that it uses are kept."""
    if image.dtype.itemsize == 2:
        used = int(image.max()).bit_length()
        image = image >> next(bits - 8 for bits in (8, 10, 12, 14, 16) if used <= bits)
    return np.asarray(image, dtype=np.uint8)


def _is_truncated(data: bytes) -> bool:
    """Whether a JPEG or PNG file lacks its end marker, behind which phones append a video."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data
    if not data.startswith(b"\xff\xd8"):
        return False
    # The segments before the scan may hold a thumbnail, which has an end marker of its own.
    at = 2
    while data[at : at + 1] == b"\xff" and data[at + 1 : at + 2] != b"\xda":
        padding = data[at + 1 : at + 2] == b"\xff"
        at += 1 if padding else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return b"\xff\xd9" not in data[at:]


def to_gray(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Convert a (height, width) grey or (height, width, 3) BGR uint8 image to (height, width).

    Raises:
        ValueError: the array is not such an image.
    """
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or 0 in image.shape:
        raise ValueError(
            f"an image is (height, width) or (height, width, 3) uint8, not {image.shape} "
            f"{image.dtype}"
        )
    if image.ndim == 2:
        return image
    if image.shape[2] != 3:
        raise ValueError(f"a colour image has 3 channels, not {image.shape[2]}")
    cv2 = optional("cv2")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
