from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import protomark as pm
from conftest import (
    CODEBOOKS,
    descriptors_for,
    random_descriptors,
    random_layers,
    reference_encode,
    vector_encoder,
)


@settings(max_examples=40, deadline=None)
@given(
    bits=st.sampled_from([64, 72, 256, 488, 512, 1024]),
    hidden=st.lists(st.integers(1, 70), max_size=3),
    dim=st.integers(1, 70),
    n=st.integers(0, 140),
    seed=st.integers(0, 2**32 - 1),
)
def test_codes_follow_their_definition(
    bits: int, hidden: list[int], dim: int, n: int, seed: int
) -> None:
    layers = random_layers([bits, *hidden, dim], seed)
    encoder = pm.Encoder(layers, [dim], name="x", descriptor="x", scale=1.0)
    descriptors = random_descriptors(n, bits, seed)
    expected = reference_encode(layers, descriptors)
    np.testing.assert_array_equal(encoder.encode(descriptors), expected)
    np.testing.assert_array_equal(encoder.encode(descriptors, threads=3), expected)


@settings(max_examples=60, deadline=None)
@given(
    input=st.sampled_from(["uint8", "float32"]),
    width=st.one_of(st.sampled_from([16, 64, 128, 130, 1024]), st.integers(16, 300)),
    hidden=st.lists(st.integers(1, 70), max_size=2),
    dim=st.integers(1, 70),
    n=st.integers(0, 140),
    input_scale=st.floats(2.0**-100, 2.0**100, width=32),
    seed=st.integers(0, 2**32 - 1),
)
def test_codes_of_vectors_follow_their_definition(
    input: str, width: int, hidden: list[int], dim: int, n: int, input_scale: float, seed: int
) -> None:
    kind: dict[str, Any] = {"input": input}
    if input == "float32":
        kind["input_scale"] = input_scale
    layers = random_layers([width, *hidden, dim], seed, input=input)
    encoder = pm.Encoder(layers, [dim], name="x", descriptor="x", scale=1.0, **kind)
    descriptors = descriptors_for(encoder, n, seed)
    with np.errstate(over="ignore"):
        expected = reference_encode(layers, descriptors, **kind)
    for threads in (1, 3):
        np.testing.assert_array_equal(encoder.encode(descriptors, threads=threads), expected)


@pytest.mark.parametrize(
    "extreme", ["all ones", "all zeros", "largest weights", "smallest weights"]
)
def test_codes_at_the_extremes(extreme: str) -> None:
    layers = random_layers([1024, 64, 64, 16])
    if "weights" in extreme:
        for layer in layers:
            layer["weights"][:] = 127 if extreme.startswith("largest") else -128
            if layer["table"] is not None:
                layer["table"][:] = 255
    encoder = pm.Encoder(layers, [16], name="x", descriptor="x", scale=1.0)
    descriptors = np.full((9, 128), 0 if extreme == "all zeros" else 255, np.uint8)
    np.testing.assert_array_equal(
        encoder.encode(descriptors), reference_encode(layers, descriptors)
    )


def test_every_instruction_set_gives_the_same_bytes(tmp_path: Path) -> None:
    """Each process reads PROTOMARK_ISA once, so every instruction set needs its process."""
    encoder = pm.Encoder(
        random_layers([512, 96, 48]), [16, 48], name="x", descriptor="x", scale=1.0
    )
    encoder.save(tmp_path / "x.pme")
    descriptors = random_descriptors(333, 512)
    descriptors[0], descriptors[1] = 0, 255
    np.save(tmp_path / "in.npy", descriptors)
    script = (
        "import sys, numpy as np, protomark as pm\n"
        "folder, isa = sys.argv[1:]\n"
        "e = pm.Encoder.load(folder + '/x.pme'); d = np.load(folder + '/in.npy')\n"
        "m = pm.PrototypeMap(e); m.add(np.arange(len(d)) // 2, d)\n"
        "h = pm.hamming_search(d, d[::-1], k=3)\n"
        "np.savez(folder + '/' + isa, e.encode(d), *m.search(d, k=3), *h)\n"
    )
    results = {}
    for isa in ("portable", ""):
        environment = {**os.environ, "PROTOMARK_ISA": isa}
        subprocess.run(
            [sys.executable, "-c", script, str(tmp_path), isa or "best"],
            env=environment,
            check=True,
        )
        results[isa] = dict(np.load(tmp_path / f"{isa or 'best'}.npz"))
    for name, expected in results["portable"].items():
        np.testing.assert_array_equal(results[""][name], expected)


def test_unknown_instruction_set_is_named() -> None:
    script = (
        "import numpy as np, protomark as pm\n"
        "pm.hamming_search(np.zeros((1, 8), np.uint8), np.zeros((1, 8), np.uint8))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PROTOMARK_ISA": "vax"},
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0
    assert "PROTOMARK_ISA=vax" in done.stderr


def test_prefix_of_a_code(encoder: pm.Encoder) -> None:
    descriptors = random_descriptors(100)
    for dim in range(1, 13):
        np.testing.assert_array_equal(
            encoder.encode(descriptors, dim=dim), encoder.encode(descriptors)[:, :dim]
        )
    assert encoder.dims == [5, 12]
    with pytest.raises(ValueError, match="gives 1 to 12 dimensions, not 13"):
        encoder.encode(descriptors, dim=13)


def test_strided_input_is_taken(encoder: pm.Encoder) -> None:
    wide = random_descriptors(50, 128)
    np.testing.assert_array_equal(
        encoder.encode(wide[:, ::2]), encoder.encode(np.ascontiguousarray(wide[:, ::2]))
    )


def test_wrong_input_is_named(encoder: pm.Encoder) -> None:
    with pytest.raises(ValueError, match="descriptors have 7 bytes, encoder 'tiny' takes 8"):
        encoder.encode(np.zeros((3, 7), np.uint8))
    with pytest.raises(TypeError, match=r"uint8 array is needed, not float32 \(3, 8\)"):
        encoder.encode(np.zeros((3, 8), np.float32))
    with pytest.raises(TypeError, match=r"uint8 array is needed, not uint8 \(8,\)"):
        encoder.encode(np.zeros(8, np.uint8))
    with pytest.raises(ValueError, match="threads must be at least 1"):
        encoder.encode(np.zeros((3, 8), np.uint8), threads=0)


def test_model_file_round_trip(
    encoder: pm.Encoder, layers: list[dict[str, Any]], tmp_path: Path
) -> None:
    made = pm.Encoder(
        layers,
        [5, 12],
        name="tiny",
        descriptor="test",
        scale=0.02,
        data="nothing",
        licence="CC0-1.0",
        notes={"time": "1 s", "ümlaut": "a\nb: c"},
        codebooks=CODEBOOKS[1:],
    )
    made.save(tmp_path / "tiny.pme")
    read = pm.Encoder.load(tmp_path / "tiny.pme")
    assert (read.name, read.descriptor, read.data, read.licence) == (
        "tiny",
        "test",
        "nothing",
        "CC0-1.0",
    )
    assert read.notes == {"time": "1 s", "ümlaut": "a\nb: c"}
    assert read.scale == np.float32(0.02)
    assert read.bits == 64
    assert read.dims == [5, 12]
    assert_codebooks(read, CODEBOOKS[1:])
    # What a model says of itself does not change which codes it gives.
    assert read.identity == made.identity == encoder.identity
    descriptors = random_descriptors(20)
    np.testing.assert_array_equal(read.encode(descriptors), encoder.encode(descriptors))
    for a, b in zip(read.layers, layers, strict=True):
        assert a["shift"] == b["shift"]
        for name in ("weights", "bias", "multipliers", "table"):
            np.testing.assert_array_equal(a[name], b[name])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda ls: ls[1].update(shift=0), "layer 1: shift must be 1 to 62"),
        (
            lambda ls: ls[0]["multipliers"].__setitem__(3, 0),
            "layer 0: multipliers must be positive",
        ),
        (lambda ls: ls.pop(1), "layer 1 has 24 inputs, 40 are needed"),
        (lambda ls: ls[0]["bias"].__setitem__(0, 2**31 - 1), "could leave 32 bits"),
        (lambda ls: ls[2].update(bias=ls[2]["bias"][:3]), "do not match its size"),
        (lambda ls: ls.clear(), "0 layers"),
    ],
)
def test_layers_that_do_not_fit(change: Any, message: str) -> None:
    layers = random_layers([64, 40, 24, 12])
    layers[0]["weights"][0, 0] = 1
    change(layers)
    with pytest.raises(ValueError, match=message):
        pm.Encoder(layers, [12], name="x", descriptor="x", scale=1.0)


def assert_codebooks(encoder: pm.Encoder, expected: list[NDArray[np.int8]]) -> None:
    assert [c.dtype for c in encoder.codebooks] == [np.int8] * len(expected)
    for a, b in zip(encoder.codebooks, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_codebooks(encoder: pm.Encoder) -> None:
    assert_codebooks(encoder, CODEBOOKS)
    other = encoder.with_codebooks(CODEBOOKS[:1])
    assert_codebooks(other, CODEBOOKS[:1])
    assert_codebooks(encoder, CODEBOOKS)
    assert (other.identity, other.name, other.dims) == (encoder.identity, "tiny", [5, 12])
    assert_codebooks(encoder.with_codebooks(()), [])
    for shape, dtype, error, message in (
        ((6, 256), np.int8, TypeError, "codebooks: each must be a"),
        ((6, 256, 2), np.int16, TypeError, "codebooks: each must be a"),
        ((6, 255, 2), np.int8, ValueError, "256 words for each subspace"),
        ((7, 256, 2), np.int8, ValueError, "256 words for each 2 numbers of a code"),
        ((2, 256, 5), np.int8, ValueError, "have 1 to 4 numbers, not 5"),
        ((2, 256, 0), np.int8, ValueError, "have 1 to 4 numbers, not 0"),
        ((0, 256, 2), np.int8, ValueError, "256 words for each 2 numbers of a code"),
    ):
        with pytest.raises(error, match=message):
            encoder.with_codebooks([np.zeros(shape, dtype)])
    with pytest.raises(ValueError, match="two codebooks have words of 2 numbers"):
        encoder.with_codebooks([CODEBOOKS[1], CODEBOOKS[1][:3]])
    with pytest.raises(ValueError, match="must be -127 to 127"):
        encoder.with_codebooks([np.full((6, 256, 2), -128, np.int8)])


@pytest.mark.parametrize("dims", [[], [0, 12], [12, 5], [5, 5, 12], [5]])
def test_dims_that_do_not_fit(layers: list[dict[str, Any]], dims: list[int]) -> None:
    with pytest.raises(ValueError, match="dims must ascend"):
        pm.Encoder(layers, dims, name="x", descriptor="x", scale=1.0)


@pytest.mark.parametrize("input", ["uint8", "float32"])
def test_model_file_of_vectors(input: str, tmp_path: Path) -> None:
    made = vector_encoder(input)
    made.save(tmp_path / "x.pme")
    read = pm.Encoder.load(tmp_path / "x.pme")
    size = 20 if input == "uint8" else 80
    for encoder in (made, read, read.with_codebooks(())):
        assert (encoder.input, encoder.inputs) == (input, 20)
        assert (encoder.bytes, encoder.bits) == (size, 8 * size)
        assert encoder.input_scale == (30 if input == "float32" else 0)
        assert encoder.identity == made.identity
    assert repr(read) == f"<protomark.Encoder 'vectors': 20 {input} -> 12 int8>"
    descriptors = descriptors_for(made, 50)
    np.testing.assert_array_equal(read.encode(descriptors), made.encode(descriptors))


@pytest.mark.parametrize(
    ("width", "kind", "message"),
    [
        (64, {"input": "int8"}, "input must be bits, uint8 or float32, not 'int8'"),
        (64, {"input_scale": 1.0}, "and 0 for others, not 1"),
        (64, {"input": "uint8", "input_scale": 1.0}, "and 0 for others, not 1"),
        (64, {"input": "float32"}, "input_scale must be positive for float32 .*, not 0"),
        (64, {"input": "float32", "input_scale": -1.0}, "must be positive"),
        (64, {"input": "float32", "input_scale": float("nan")}, "must be positive"),
        (64, {"input": "float32", "input_scale": float("inf")}, "must be positive"),
        (15, {"input": "uint8"}, "has 16 to 1024 numbers, not 15"),
        (1025, {"input": "uint8"}, "has 16 to 1024 numbers, not 1025"),
        (72, {}, None),
        (16, {}, "64 to 1024 bits"),
    ],
)
def test_inputs_that_do_not_fit(width: int, kind: dict[str, Any], message: str | None) -> None:
    layers = random_layers([width, 12])

    def make() -> pm.Encoder:
        return pm.Encoder(layers, [12], name="x", descriptor="x", scale=1.0, **kind)

    if message is None:
        assert make().input == "bits"
        return
    with pytest.raises(ValueError, match=message):
        make()


def test_sums_of_bytes_beyond_32_bits() -> None:
    layers = random_layers([1024, 12])
    layers[0]["weights"][:] = 127
    layers[0]["bias"][:] = 2**31 - 1 - 127 * 1024 * 255
    kind: dict[str, Any] = {"dims": [12], "name": "x", "descriptor": "x", "scale": 1.0}
    encoder = pm.Encoder(layers, **kind, input="uint8")
    extreme = np.full((2, 1024), 255, np.uint8)
    np.testing.assert_array_equal(
        encoder.encode(extreme), reference_encode(layers, extreme, "uint8")
    )
    layers[0]["bias"][3] += 1
    with pytest.raises(ValueError, match="sums of output 3 could leave 32 bits"):
        pm.Encoder(layers, **kind, input="uint8")
    assert pm.Encoder(layers, **kind).bits == 1024


@pytest.mark.parametrize("input", ["uint8", "float32"])
def test_vectors_that_are_refused(input: str, tmp_path: Path) -> None:
    encoder = vector_encoder(input)
    n = 9000  # more than are encoded at a time
    good = descriptors_for(encoder, n)
    ids = np.arange(n) // 2
    scene = pm.PrototypeMap(encoder)
    scene.add(ids, good)
    prototypes = scene.prototypes(scene.ids)
    sealed = scene.seal(tmp_path / "sealed.pmk", ids, good, bytes_per_landmark=4)
    path = tmp_path / "no.pmk"
    calls = (
        encoder.encode,
        lambda d: scene.add(ids, d),
        lambda d: scene.add(ids, d, threads=3),
        lambda d: scene.subtract(ids, d),
        lambda d: scene.seal(path, ids, d, bytes_per_landmark=4),
        scene.search,
        sealed.search,
        lambda d: pm.match(scene, d),
        lambda d: pm.match(sealed, d),
    )

    def refused(descriptors: Any, error: type[Exception], message: str) -> None:
        for call in calls[:-2] if error is ValueError else calls:  # match asks for a calibration
            with pytest.raises(error, match=message):
                call(descriptors)

    kind = {"uint8": np.uint8, "float32": np.float32}[input]
    for other in (np.uint8, np.float32, np.float64, np.float16, np.int32, bool, ">f4"):
        if other is not kind:
            wrong = rf"descriptors: a \(n, 20\) {input} array is needed, not .* \(9000, 20\)"
            refused(good.astype(other), TypeError, wrong)
    refused(good[0], TypeError, rf"{input} array is needed, not {input} \(20,\)")
    size = good.dtype.itemsize
    refused(
        good[:, :19],
        ValueError,
        f"descriptors have {19 * size} bytes, encoder 'vectors' takes {20 * size}",
    )
    for value in (0, np.nan, np.inf, -np.inf) if input == "float32" else (0,):
        bad = good.copy()
        bad[8500, :] = value
        bad[8700] = value
        why = "has a NaN or an infinity" if value else "is all zeros"
        refused(bad, ValueError, f"descriptors: row 8500 {why}")
    assert not path.exists()
    np.testing.assert_array_equal(scene.prototypes(scene.ids), prototypes)
    # Whatever the strides.
    np.testing.assert_array_equal(encoder.encode(good[::-2]), encoder.encode(good)[::-2])
    np.testing.assert_array_equal(encoder.encode(np.asfortranarray(good)), encoder.encode(good))
    scene.subtract(ids, good)
    assert len(scene) == 0


def test_unknown_encoder_is_named() -> None:
    with pytest.raises(FileNotFoundError, match="sift: neither a model file nor a bundled"):
        pm.Encoder.load("sift")
