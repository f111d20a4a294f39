"""Measures `protomark serve`: requests a second, and how long answers take.

python benchmarks/scripts/service_speed.py FOLDER TRACKS... [--landmarks 10000000] [--rate 20]

Features are given: 1,000 keypoints a request, as safetensors. Without --landmarks the map is that
of the sample, and frames are its keyframes. Otherwise it is one of synthetic landmarks in FOLDER,
which is made if it is not there (see `localizer_memory`): 32 numbers sealed to --bytes, index,
16-bit positions, with --shards in as many shards by id, whose lists are as long as those of one
map. The rows with so many clients ask again as soon as they have an answer; in the row with a rate,
requests come at fixed times, and an answer takes as long as it comes after the time of its request.
CPU is that of the server's process alone. Options behind -- go to `protomark serve`.
"""

from __future__ import annotations

import argparse
import http.client
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

import protomark as pm
from localizer_memory import CAMERA, DIM, PLACE, THREADS, center, frame, learning_map
from protomark import sample
from protomark.evaluation.frames import QueryFrame
from protomark.geometry.pose import camera_centers
from protomark.maps.build import build_map
from protomark.maps.sharded_map import open_scene
from protomark.maps.shards import Manifest, describe_file, describe_shard, encoder_facts
from protomark_bench.report import ReportTable
from protomark_bench.speed.landmarks import RealLandmarks, SyntheticLandmarks

KEYPOINTS = 1000
CLIENTS = (1, 2, 4)
# An answer is right if the camera is no farther off, in the map's unit.
_RIGHT = 0.1
_SENDERS = 64  # requests on their way at a time at a fixed rate


@dataclass(frozen=True)
class Request:
    """Features of a frame, and where it was taken."""

    body: bytes
    camera: str
    center: NDArray[np.float64]


def sample_requests(path: Path) -> list[Request]:
    """Keyframes of the sample, whose map is saved at a path."""
    tracks = sample.load()
    build_map(tracks, pm.Encoder.load(tracks.descriptor), DIM).save(path)
    requests = []
    for i in range(len(tracks.keyframe_names)):
        query = QueryFrame.of(tracks, i)
        body = _features(query.keypoints[:KEYPOINTS], query.descriptors[:KEYPOINTS])
        at = camera_centers(query.cam_from_world[None])[0]
        requests.append(Request(body, str(query.camera), at))
    return requests


def synthetic_requests(
    path: Path, tracks: list[Path], landmarks: int, size: float | None, shards: int, count: int
) -> list[Request]:
    """Frames at random places of a map at a path, which is made if it is not there."""
    real = RealLandmarks.load(tracks)
    encoder = pm.Encoder.load(real.descriptor)
    synthetic = SyntheticLandmarks(real, encoder, DIM, observations=2, threads=THREADS)
    if not path.exists():
        _make(path, synthetic, encoder, landmarks, size, shards)
    scene, rng = open_scene(path), np.random.default_rng(2)
    places = rng.integers(0, landmarks // PLACE, count)
    return [
        Request(_features(*frame(scene, synthetic, int(p), rng)), str(CAMERA), center(p))
        for p in places
    ]


def _make(
    path: Path,
    synthetic: SyntheticLandmarks,
    encoder: pm.Encoder,
    landmarks: int,
    size: float | None,
    shards: int,
) -> None:
    def seal(file: Path, first: int, last: int) -> pm.SealedMap:
        scene = learning_map(synthetic, encoder, first, last)
        lists = None if shards < 2 else max(1, int(4 * landmarks**0.5) // shards)
        scene.build_index(lists, threads=THREADS, in_place=True)
        return scene.seal(file, bytes_per_landmark=size, position_bits=16, tune=False)

    if shards < 2:
        seal(path, 0, landmarks)
        return
    path.mkdir(parents=True)
    cuts = [round(landmarks * i / shards / PLACE) * PLACE for i in range(shards)] + [landmarks]
    described = []
    for i, (first, last) in enumerate(itertools.pairwise(cuts)):
        file = path / f"{i:03}.sealed.pmk"
        scene = seal(file, first, last)
        described.append(describe_shard(f"{i:03}", scene, sealed=describe_file(file)))
    Manifest(encoder_facts(encoder), DIM, None, {}, described).save(path)


def _features(keypoints: NDArray[np.float64], descriptors: NDArray[np.uint8]) -> bytes:
    return save({"keypoints": keypoints, "descriptors": np.ascontiguousarray(descriptors)})


@contextmanager
def served(path: Path, options: list[str]) -> Iterator[tuple[str, int]]:
    """Host and port of a server of a map."""
    words = [sys.executable, "-m", "protomark", "serve", str(path), "--port", "0", *options]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    try:
        while not (found := re.match(r"http://([\d.]+):(\d+)", line := process.stderr.readline())):
            if not line:
                raise SystemExit("the server has ended")
        threading.Thread(target=process.stderr.read, daemon=True).start()
        yield found[1], int(found[2])
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait()


@dataclass
class Load:
    """Asks a server, and records how long each answer took."""

    address: tuple[str, int]
    requests: list[Request]

    def __post_init__(self) -> None:
        self.seconds: list[float] = []
        self.right = self.failed = 0
        self._number = itertools.count()

    def ask(self, connection: http.client.HTTPConnection, since: float | None = None) -> None:
        """Send the next request; its answer is late from `since` on, or from now."""
        request = self.requests[next(self._number) % len(self.requests)]
        began = since or time.perf_counter()
        path = "/localize?camera=" + request.camera.replace(" ", "+")
        connection.request("POST", path, request.body)
        reply = connection.getresponse()
        answer = json.loads(reply.read())
        self.seconds.append(time.perf_counter() - began)
        self.failed += reply.status != 200
        at = answer.get("center")
        self.right += at is not None and bool(np.linalg.norm(at - request.center) < _RIGHT)

    def in_threads(self, count: int, work: Callable[[http.client.HTTPConnection], None]) -> float:
        """Run `work` in threads, each with a connection; seconds until all have ended."""
        connections = [http.client.HTTPConnection(*self.address) for _ in range(count)]
        threads = [threading.Thread(target=work, args=(c,)) for c in connections]
        began = time.perf_counter()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return time.perf_counter() - began

    def closed(self, clients: int, seconds: float) -> float:
        """So many clients, each of which asks again when it has its answer."""
        end = time.perf_counter() + seconds

        def work(connection: http.client.HTTPConnection) -> None:
            while time.perf_counter() < end:
                self.ask(connection)

        return self.in_threads(clients, work)

    def at_rate(self, rate: float, seconds: float) -> float:
        """Requests at fixed times, whatever the server does."""
        start = time.perf_counter() + 0.1
        due = iter([start + i / rate for i in range(int(rate * seconds))])
        lock = threading.Lock()

        def work(connection: http.client.HTTPConnection) -> None:
            while True:
                with lock:
                    at = next(due, None)
                if at is None:
                    return
                time.sleep(max(0.0, at - time.perf_counter()))
                self.ask(connection, at)

        return self.in_threads(_SENDERS, work) - 0.1


def cpu_seconds(address: tuple[str, int]) -> float:
    """CPU time of the server's process."""
    connection = http.client.HTTPConnection(*address)
    connection.request("GET", "/metrics")
    text = connection.getresponse().read().decode()
    return float(text.partition("\nprocess_cpu_seconds_total ")[2].partition("\n")[0])


def measure(
    address: tuple[str, int], requests: list[Request], seconds: float, rates: list[float]
) -> list[list[str]]:
    """A row for each load."""
    Load(address, requests).closed(2, 3)  # warms up
    loads: list[tuple[str, Callable[..., float]]] = [
        *((f"{n} client{'s' * (n > 1)}", partial(Load.closed, clients=n)) for n in CLIENTS),
        *((f"{rate:g} a second", partial(Load.at_rate, rate=rate)) for rate in rates),
    ]
    rows = []
    for name, run in loads:
        load, before = Load(address, requests), cpu_seconds(address)
        took = run(load, seconds=seconds)
        count = len(load.seconds)
        p50, p99 = 1000 * np.quantile(load.seconds, (0.5, 0.99))
        cpu = 1000 * (cpu_seconds(address) - before) / count
        answers = f"{load.right} of {count}" + (f", {load.failed} failed" if load.failed else "")
        rows.append(
            [name, f"{count / took:.1f}", f"{p50:.0f}", f"{p99:.0f}", f"{cpu:.0f}", answers]
        )
        print(" ".join(rows[-1]), file=sys.stderr, flush=True)
    return rows


def main() -> None:
    """Prints the table of a map for docs/results/serving.md."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("tracks", type=Path, nargs="*", help="of one descriptor")
    parser.add_argument("--landmarks", type=int, default=0)
    parser.add_argument("--bytes", type=float, default=17, help="0: int8 numbers")
    parser.add_argument("--shards", type=int, default=1)
    parser.add_argument("--recall", type=float, default=0.98)
    parser.add_argument("--rate", type=float, nargs="*", default=[20.0])
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--frames", type=int, default=200)
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    args, options = parser.parse_args(words[:cut]), words[cut + 1 :]
    args.folder.mkdir(parents=True, exist_ok=True)
    if args.landmarks:
        shards = f".{args.shards}-shards" if args.shards > 1 else ".pmk"
        path = args.folder / f"{args.landmarks}.{args.bytes:g}{shards}"
        requests = synthetic_requests(
            path, args.tracks, args.landmarks, args.bytes or None, args.shards, args.frames
        )
        options += ["--recall", f"{args.recall:g}"]
    else:
        path = args.folder / "sample.pmk"
        requests = sample_requests(path)
    with served(path, options) as address:
        rows = measure(address, requests, args.seconds, args.rate)
    busy = "/".join(f"{n:.0f}" for n in os.getloadavg())
    print(f"{path.name}, {' '.join(options)}, load average at the end {busy}")
    heads = ["load", "answers a second", "p50, ms", "p99, ms", "CPU ms each", "right"]
    print(ReportTable(heads, rows).markdown())


if __name__ == "__main__":
    main()
