"""Measures distributed builds and sharded search: docs/results/distributed.md.

    python benchmarks/scripts/distributed_runs.py memory --memory 200 --times 20
    python benchmarks/scripts/distributed_runs.py overhead
    python benchmarks/scripts/distributed_runs.py faults
    python benchmarks/scripts/distributed_runs.py search

Sessions are synthetic: each landmark has a random descriptor, of which an observation has 1/16 of
the bits flipped, and is seen ten times by frames that follow each other.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import random
import shutil
import signal
import statistics
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import protomark as pm
from protomark.distributed import build
from protomark.maps.build import build_map
from protomark.maps.origin import tracks_metadata
from protomark.maps.sources import read_places
from protomark.maps.split import split_file
from protomark.tracks.file import ARRAYS

OBSERVATIONS = 10
KEYPOINT_BYTES = 96
CAMERA = {"model": "PINHOLE", "width": 640, "height": 480, "params": [500.0, 500.0, 320.0, 240.0]}
METADATA = {"created": "2026-12-01T00:00:00Z"}


def write_session(path: Path, count: int, seed: int = 0) -> None:
    """Write a tracks file of `count` keypoints, block by block."""
    landmarks, frames, block = count // OBSERVATIONS, max(1, count // 1000), 1_000_000
    sizes = {"m": frames, "m+1": frames + 1, "n": count, "l": landmarks, "b": 64}
    header: dict[str, Any] = {
        "__metadata__": {
            "format": "protomark-tracks",
            "version": "1",
            "descriptor": "freak",
            "cameras": json.dumps({"1": CAMERA}),
            "keyframe_names": json.dumps([f"{i}.jpg" for i in range(frames)]),
            "info": "{}",
        }
    }
    names = {"float32": "F32", "float64": "F64", "int32": "I32", "int64": "I64", "uint8": "U8"}
    end = 0
    for name, (dtype, shape) in ARRAYS.items():
        rows = [sizes[s] if isinstance(s, str) else s for s in shape]
        begin, end = end, end + int(np.prod(rows)) * np.dtype(dtype).itemsize
        kind = names[np.dtype(dtype).name]
        header[name] = {"dtype": kind, "shape": rows, "data_offsets": [begin, end]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    rng = np.random.default_rng(seed)
    seeds = rng.integers(0, 2**63, 8, dtype=np.uint64)

    def labels(start: int, stop: int) -> Any:
        return (np.arange(start, stop) // OBSERVATIONS).clip(0, landmarks - 1)

    def descriptors(start: int, stop: int) -> Any:
        ids = labels(start, stop).astype(np.uint64)[:, None] + np.uint64(seed << 40)
        word = (ids + seeds) * np.uint64(0x9E3779B97F4A7C15)
        word ^= word >> np.uint64(29)
        word *= np.uint64(0xBF58476D1CE4E5B9)
        word ^= word >> np.uint64(32)
        flips = rng.integers(0, 2**64, (4, stop - start, 8), dtype=np.uint64)
        return (word ^ (flips[0] & flips[1] & flips[2] & flips[3])).view(np.uint8)

    make: dict[str, Callable[[int, int], Any]] = {
        "keyframe_camera": lambda a, b: np.ones(b - a),
        "cam_from_world": lambda a, b: np.tile(np.eye(3, 4), (b - a, 1, 1)),
        "offsets": lambda a, b: (
            np.arange(a, b) * (count // frames) * (np.arange(a, b) < frames)
            + count * (np.arange(a, b) == frames)
        ),
        "descriptors": descriptors,
        "landmark_of_keypoint": labels,
        "landmark_ids": lambda a, b: np.arange(a, b),
        "landmark_positions": lambda a, b: rng.normal(0, 100, (b - a, 3)),
        "keypoints": lambda a, b: rng.uniform(0, 480, (b - a, 2)),
    }
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        for name, (dtype, _) in ARRAYS.items():
            total = header[name]["shape"][0]
            for start in range(0, total, block):
                stop = min(start + block, total)
                values = make[name](start, stop) if name in make else np.ones(stop - start)
                file.write(np.ascontiguousarray(values, dtype).tobytes())


@contextlib.contextmanager
def cluster_of(cpus: list[int], store: int) -> Iterator[Any]:
    """A cluster on this machine with a node for each number of CPUs."""
    import ray
    from ray.cluster_utils import Cluster

    first, *others = ({"num_cpus": n, "object_store_memory": store} for n in cpus)
    cluster = Cluster(initialize_head=True, head_node_args=first)
    try:
        for node in others:
            cluster.add_node(**node)
        ray.init(address=cluster.address, log_to_driver=False)
        yield cluster
    finally:
        ray.shutdown()
        cluster.shutdown()


def workers_of(cluster: Any) -> Iterator[tuple[int, str]]:
    """Process and title of each of a cluster's workers that has begun a task."""
    raylets = {
        node.all_processes["raylet"][0].process.pid
        for node in cluster.list_all_nodes()
        if "raylet" in node.all_processes
    }
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            title = (path / "cmdline").read_bytes().partition(b"\0")[0].decode().strip()
            if parent in raylets and title.startswith("ray::") and "Agent" not in title:
                yield int(path.name), title


@contextlib.contextmanager
def meanwhile(action: Callable[[], None], every: float) -> Iterator[None]:
    """Do something again and again while the block runs."""
    stop = threading.Event()

    def repeat() -> None:
        while not stop.wait(every):
            action()

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def cpu_seconds() -> float:
    """CPU time of this process and of all that it started, ended ones included."""
    rows = {}
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            fields = (path / "stat").read_text().rpartition(")")[2].split()
            rows[int(path.name)] = int(fields[1]), sum(map(int, fields[11:15]))
    mine, grown = {os.getpid()}, True
    while grown:
        more = {process for process, (parent, _) in rows.items() if parent in mine} - mine
        mine, grown = mine | more, bool(more)
    return sum(rows[process][1] for process in mine) / os.sysconf("SC_CLK_TCK")


def memory(folder: Path, megabytes: float, times: float, seal: bool) -> dict[str, Any]:
    """Peak memory of workers whose input is `times` what each may take."""
    source = folder / "large.freak.safetensors"
    count = int(megabytes * 1e6 * times / KEYPOINT_BYTES)
    # Elsewhere, as the peak of this process is that of the driver.
    writer = multiprocessing.get_context("spawn").Process(
        target=write_session, args=(source, count)
    )
    writer.start()
    writer.join()
    peaks: dict[str, dict[str, int]] = {}
    with cluster_of([2], int(megabytes * 1e6)) as cluster:

        def sample() -> None:
            for process, title in workers_of(cluster):
                with contextlib.suppress(OSError):
                    rows = (Path("/proc") / str(process) / "status").read_text().splitlines()
                    found = {r.split(":")[0]: int(r.split()[1]) * 1024 for r in rows if "kB" in r}
                    own = found["RssAnon"] + found["RssFile"]
                    best = peaks.setdefault(title, {"own": 0, "with shared": 0})
                    best["own"] = max(best["own"], own)
                    best["with shared"] = max(best["with shared"], found["VmRSS"])

        with meanwhile(sample, 0.05):
            facts = build([source], folder / "city", memory=megabytes, metadata=METADATA, seal=seal)
    rows = Path("/proc/self/status").read_text().splitlines()
    driver = max(int(row.split()[1]) for row in rows if row.startswith("VmHWM"))
    return {
        "memory": megabytes,
        "input_bytes": source.stat().st_size,
        "peaks": peaks,
        "driver": driver * 1024,
        "shards": facts["shards"],
        "prototypes": facts["prototypes"],
        "run": facts["run"],
    }


def overhead(folder: Path, count: int) -> dict[str, Any]:
    """Throughput of one process, and of clusters of one and of several nodes."""
    sources = []
    for i in range(4):
        sources.append(folder / f"session{i}.freak.safetensors")
        write_session(sources[-1], count // 4, i)
    began, before = time.perf_counter(), cpu_seconds()
    seen = read_places(sources)
    scene = build_map(seen, pm.Encoder.load("freak"), min_observations=1)
    scene.metadata = tracks_metadata(seen) | METADATA
    scene.save(folder / "one.pmk")
    found: dict[str, Any] = {"observations": count, "one process": time.perf_counter() - began}
    found["CPU seconds of one process"] = cpu_seconds() - before
    del seen, scene
    contents = []
    for cpus in ([1], [2], [1, 1], [1, 1, 1, 1]):
        with cluster_of(cpus, 300_000_000):
            build(sources[:1], folder / "warm", memory=400, metadata=METADATA, seal=False)
            before = cpu_seconds()
            facts = build(sources, folder / "city", memory=400, metadata=METADATA, seal=False)
            used = cpu_seconds() - before
        found[f"workers by node: {cpus}"] = {**facts["run"], "CPU seconds": used}
        contents.append({p.name: p.read_bytes() for p in (folder / "city").iterdir()})
    found["same bytes"] = all(one == contents[0] for one in contents)
    return found


def faults(folder: Path, count: int, every: float) -> dict[str, Any]:
    """The same bytes with a worker killed every few seconds, and a node removed."""
    source = folder / "session.freak.safetensors"
    write_session(source, count)
    options: dict[str, Any] = {"memory": 250, "metadata": METADATA, "seal": False}
    killed, removed = list[str](), list[Any]()
    with cluster_of([1, 1], 200_000_000) as cluster:
        calm = build([source], folder / "calm", **options)["run"]

        def kill() -> None:
            if workers := [w for w in workers_of(cluster) if w[1] != "ray::IDLE"]:
                process, title = random.choice(workers)
                killed.append(title)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)

        with meanwhile(kill, every):
            worker = build([source], folder / "killed", **options)["run"]
        gone = threading.Timer(
            calm["seconds"] / 3,
            lambda: removed.append(
                cluster.remove_node(cluster.list_all_nodes()[-1], allow_graceful=False)
            ),
        )
        gone.start()
        node = build([source], folder / "removed", **options)["run"]
        assert removed, "the build was done before a node was removed"
        gone.join()
    same = [
        {p.name: p.read_bytes() for p in (folder / name).iterdir()}
        for name in ("calm", "killed", "removed")
    ]
    return {
        "observations": count,
        "without faults": calm,
        "killed": len(killed),
        "with kills": worker,
        "with a node removed": node,
        "same bytes": same[0] == same[1] == same[2],
    }


def search(folder: Path, count: int) -> dict[str, Any]:
    """Time of a search in one map and in its shards, in turns."""
    source = folder / "session.freak.safetensors"
    write_session(source, count)
    scene = build_map(read_places([source]), pm.Encoder.load("freak"), min_observations=1)
    scene.save(folder / "one.pmk")
    split_file(folder / "one.pmk", folder / "shards", parts=16)
    split_file(folder / "one.pmk", folder / "sealed", parts=16, sealed=True)
    scene.seal(folder / "one.sealed.pmk")
    queries = np.random.default_rng(1).integers(0, 256, (1000, 64), dtype=np.uint8)
    found: dict[str, Any] = {"landmarks": len(scene), "prototypes": scene.prototype_count}
    for kind, one, shards in (
        ("learning", scene, folder / "shards"),
        ("sealed", pm.open(folder / "one.sealed.pmk"), folder / "sealed"),
    ):
        maps = {"one": one, "shards": pm.ShardedMap(shards)}
        codes = one.encoder.encode(queries, one.dim)
        answers = {name: scene.search_codes(codes) for name, scene in maps.items()}
        same = all(np.array_equal(*pair) for pair in zip(*answers.values(), strict=True))
        seconds: dict[str, list[float]] = {name: [] for name in maps}
        for _ in range(15):
            for name, scene_ in maps.items():
                began = time.perf_counter()
                scene_.search_codes(codes)
                seconds[name].append(time.perf_counter() - began)
        medians = {name: statistics.median(times) for name, times in seconds.items()}
        fastest = {name: min(times) for name, times in seconds.items()}
        found[kind] = {
            "same answers": same,
            "median seconds": medians,
            "fastest seconds": fastest,
            "ratio of medians": medians["shards"] / medians["one"],
            "ratio of fastest": fastest["shards"] / fastest["one"],
        }
    return found


def main() -> None:
    """Run one of the measurements and print its figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["memory", "overhead", "faults", "search"])
    parser.add_argument("--memory", type=float, default=200)
    parser.add_argument("--times", type=float, default=20)
    parser.add_argument("--seal", action="store_true")
    parser.add_argument("--observations", type=int, default=4_000_000)
    parser.add_argument("--every", type=float, default=3)
    parser.add_argument("--folder", type=Path, help="where to put gigabytes")
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="protomark-", dir=given.folder))
    try:
        found = {
            "memory": lambda: memory(folder, given.memory, given.times, given.seal),
            "overhead": lambda: overhead(folder, given.observations),
            "faults": lambda: faults(folder, given.observations, given.every),
            "search": lambda: search(folder, given.observations),
        }[given.what]()
    finally:
        shutil.rmtree(folder)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
