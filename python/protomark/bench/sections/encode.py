"""Descriptors to codes, beside the same network in PyTorch and ONNX Runtime."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.bench.peers import installed
from protomark.bench.peers.network import bits_of, float_layers
from protomark.bench.progress import Bar
from protomark.bench.race import Contender, race, turns
from protomark.bench.results import Contest, Results
from protomark.bench.workload import Workload

ENCODERS = ("freak", "orb")
BATCH = 1_000


def run(workload: Workload, results: Results, bar: Bar) -> None:
    """The shipped FREAK and ORB networks, in batches of 1,000 and a whole set at once."""
    settings = workload.settings
    sizes = (BATCH, settings.encoded)
    bar.begin("encode", len(ENCODERS) * len(sizes) * turns(5, settings.pace))
    for name in ENCODERS:
        encoder = pm.Encoder.load(name)
        descriptors = _descriptors(workload, encoder, settings.encoded)
        for size in sizes:
            entrants = _contenders(encoder, descriptors[:size], settings.dim, settings.threads)
            results.contests.append(
                Contest(
                    "encode",
                    f"{name}, {size:,} at a time, {settings.dim}-d",
                    "descriptor",
                    settings.threads,
                    work={"multiply_adds": multiply_adds(encoder, settings.dim)},
                    timings=race(entrants, size, settings.pace, bar.advance),
                )
            )


def multiply_adds(encoder: pm.Encoder, dim: int) -> float:
    """Multiply-adds for one descriptor's first `dim` numbers."""
    last = encoder.layers[-1]["weights"]
    return float(encoder.multiply_adds - last.size + dim * last.shape[1])


def _descriptors(workload: Workload, encoder: pm.Encoder, count: int) -> NDArray[np.uint8]:
    """Real ones where they are of this encoder's descriptor, else random bits."""
    rng = np.random.default_rng(0)
    if encoder.descriptor == workload.encoder.descriptor:
        return workload.real.descriptors[rng.integers(0, len(workload.real.descriptors), count)]
    return rng.integers(0, 256, (count, encoder.bits // 8), np.uint8)


def _contenders(
    encoder: pm.Encoder, descriptors: NDArray[np.uint8], dim: int, threads: int
) -> list[Contender]:
    layers = float_layers(encoder, dim)
    bits = bits_of(descriptors)
    entrants = [
        Contender(
            "Protomark",
            lambda n: encoder.encode(descriptors[:n], dim=dim, threads=threads),
            ours=True,
            least=BATCH,
        )
    ]
    if installed("torch"):
        from protomark.bench.peers import torch_network

        entrants.append(Contender("PyTorch float", torch_network.runner(layers, bits), least=BATCH))
    if installed("onnxruntime", "onnx"):
        from protomark.bench.peers import onnx_network

        floats = bits.astype(np.float32)
        for name, model, inputs in (
            ("ONNX Runtime float", onnx_network.float_model(layers), floats),
            ("ONNX Runtime int8, static", onnx_network.static_model(layers), bits),
            ("ONNX Runtime int8, dynamic", onnx_network.dynamic_model(layers), bits),
        ):
            entrants.append(
                Contender(name, onnx_network.runner(model, inputs, threads), least=BATCH)
            )
    return entrants
