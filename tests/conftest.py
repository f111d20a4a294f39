"""Fixtures that tests share: a small encoder with random weights, its codes, and the command."""

from __future__ import annotations

import ctypes
import gc
import io
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from numpy.typing import NDArray

import protomark as pm

# Sequences whose images may not ship; tests that need them are skipped where they are not.
DATA = Path(os.environ.get("PROTOMARK_SHARED", Path(__file__).parents[2] / "shared")) / "data"

NO_DISTANCE = int(np.iinfo(np.int32).max)  # where there is no neighbour

# A busy machine is no failure of a property.
settings.register_profile("protomark", deadline=None)
settings.load_profile("protomark")


def program(*arguments: Any) -> subprocess.CompletedProcess[str]:
    """The command as users run it."""
    words = [sys.executable, "-m", "protomark", *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True)


def protomark(*arguments: Any) -> subprocess.CompletedProcess[str]:
    """The command in this process, which saves the time to start another."""
    from protomark.cli import main

    words = ["protomark", *map(str, arguments)]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with redirect_stdout(out), redirect_stderr(err), pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", words)
        try:
            main()
        except SystemExit as stop:
            code = int(stop.code or 0)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def random_layers(
    widths: list[int], seed: int = 0, weight_limit: int = 127, input: str = "bits"
) -> list[dict[str, Any]]:
    """Integer layers whose sums spread over the whole range of the activation table."""
    rng = np.random.default_rng(seed)
    layers = []
    for i, (inputs, outputs) in enumerate(pairwise(widths)):
        last = i == len(widths) - 2
        spread = (0.5 if i == 0 and input == "bits" else 128) * weight_limit * inputs**0.5
        layers.append(
            {
                "weights": rng.integers(-weight_limit, weight_limit + 1, (outputs, inputs)).astype(
                    np.int8
                ),
                "bias": rng.integers(-1000, 1000, outputs).astype(np.int32),
                "multipliers": (rng.uniform(40, 120, outputs) / spread * 2**30).astype(np.int32)
                + 1,
                "shift": 30,
                "table": None if last else np.sort(rng.integers(0, 256, 256)).astype(np.uint8),
            }
        )
    return layers


def random_codebooks(*shapes: tuple[int, int]) -> list[NDArray[np.int8]]:
    """Codebooks of random words, each for (subspaces, width)."""
    rng = np.random.default_rng(5)
    return [
        rng.integers(-127, 128, (subspaces, 256, width)).astype(np.int8)
        for subspaces, width in shapes
    ]


# Prototypes of 12 numbers take 12 bytes, or 6 or 4 words; of 5 numbers, 8 bytes or 5 words.
CODEBOOKS = random_codebooks((5, 1), (6, 2), (4, 3))


def reference_encode(
    layers: list[dict[str, Any]],
    descriptors: NDArray[Any],
    input: str = "bits",
    input_scale: float = 0.0,
) -> Any:
    """The definition in core/include/protomark/encoder.h, in NumPy."""
    x: NDArray[Any] = descriptors
    if input == "bits":
        x = np.unpackbits(descriptors, axis=1, bitorder="little")
    elif input == "float32":
        x = np.clip(np.rint(descriptors * np.float32(input_scale)), -127, 127) + 128
    for layer in layers:
        # Sums stay far below 2^53, so float64 matrix products are exact, and fast.
        products = x.astype(np.float64) @ layer["weights"].T.astype(np.float64)
        sums = products.astype(np.int64) + layer["bias"]
        t = (sums * layer["multipliers"] + (1 << (layer["shift"] - 1))) >> layer["shift"]
        if layer["table"] is None:
            return np.clip(t, -127, 127).astype(np.int8)
        x = layer["table"][np.clip(t, -128, 127) + 128]
    raise AssertionError("the last layer has a table")


def random_descriptors(n: int, bits: int = 64, seed: int = 0) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (n, bits // 8), dtype=np.uint8)


def vector_encoder(input: str, width: int = 20) -> pm.Encoder:
    """Numbers of a type to 12 dimensions."""
    layers = random_layers([width, 24, 12], seed=3, input=input)
    scale = 30.0 if input == "float32" else 0.0
    return pm.Encoder(
        layers,
        [5, 12],
        name="vectors",
        descriptor="test",
        scale=0.02,
        codebooks=CODEBOOKS,
        input=input,
        input_scale=scale,
    )


def descriptors_for(encoder: pm.Encoder, n: int, seed: int = 0) -> NDArray[Any]:
    """Random descriptors that an encoder takes."""
    rng = np.random.default_rng(seed)
    if encoder.input != "float32":
        return rng.integers(0, 256, (n, encoder.bytes), dtype=np.uint8)
    # Halves of quantised numbers, up to twice as large as the largest one.
    halves = rng.integers(-508, 509, (n, encoder.inputs)) / 2
    return (halves / encoder.input_scale).astype(np.float32)


def rounded(means: Any) -> Any:
    """Rounds to integers, halves away from zero."""
    return (np.sign(means) * np.floor(np.abs(means) + 0.5)).astype(np.int64)


@pytest.fixture(scope="session", autouse=True)
def no_drawing() -> Iterator[None]:
    """Reports have no pictures, which would take most of the time of mapping a few frames."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("protomark.report.svg_text", lambda figure: "<svg></svg>")
        yield


@pytest.fixture(scope="session")
def layers() -> list[dict[str, Any]]:
    return random_layers([64, 40, 24, 12])


@pytest.fixture(scope="session")
def encoder(layers: list[dict[str, Any]]) -> pm.Encoder:
    """64 bits to 12 dimensions, prefix of 5: no length is a multiple of a vector register's."""
    return pm.Encoder(
        layers, [5, 12], name="tiny", descriptor="test", scale=0.02, codebooks=CODEBOOKS
    )


def balanced_encoder() -> pm.Encoder:
    """64 bits to 12 dimensions, of which each is as often above zero as below."""
    layers = random_layers([64, 12])
    layers[0]["bias"] = (-layers[0]["weights"].sum(axis=1, dtype=np.int64) // 2).astype(np.int32)
    return pm.Encoder(
        layers, [5, 12], name="balanced", descriptor="test", scale=0.02, codebooks=CODEBOOKS
    )


class _MallocInfo(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_size_t)
        for name in [
            "arena",
            "ordblks",
            "smblks",
            "hblks",
            "hblkhd",
            "usmblks",
            "fsmblks",
            "uordblks",
            "fordblks",
            "keepcost",
        ]
    ]


def allocated_bytes() -> int | None:
    """Bytes that this process has allocated and not freed; None without glibc 2.33 or newer."""
    gc.collect()
    try:
        mallinfo = ctypes.CDLL(None).mallinfo2
    except (AttributeError, OSError, TypeError):
        return None
    mallinfo.restype = _MallocInfo
    info = mallinfo()
    return int(info.uordblks + info.hblkhd)
