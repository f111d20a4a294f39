"""Lists and reads images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.files import natural_key

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".webp")


def image_names(folder: Path) -> list[str]:
    """Names of the images below a folder, relative to it, in natural order (img2 before img10)."""
    files = (f for f in folder.rglob("*") if f.suffix.lower() in IMAGE_SUFFIXES and f.is_file())
    return sorted((f.relative_to(folder).as_posix() for f in files), key=natural_key)


def read_gray(path: Path) -> NDArray[np.uint8]:
    """Read an image as (height, width) uint8, exactly as stored (not rotated by EXIF).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not an image, or it is truncated.
    """
    cv2 = optional("cv2")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such image")
    data = np.fromfile(path, dtype=np.uint8)
    # OpenCV fills the missing rows of a truncated image with grey and only warns.
    start, end = data[:4].tobytes(), data[-4096:].tobytes()
    for magic, last in ((b"\xff\xd8", b"\xff\xd9"), (b"\x89PNG", b"IEND")):
        if start.startswith(magic) and last not in end:
            raise ValueError(
                f"{path}: the image is truncated (its end marker is missing), copy it anew"
            )
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(data, flags) if len(data) else None
    if image is None:
        raise ValueError(f"{path}: the image is truncated, or of an unknown format: copy it anew")
    return np.asarray(image, dtype=np.uint8)


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
