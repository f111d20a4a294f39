"""Distributed builds on a cluster of this machine: the same bytes whatever happens.

`make test-ray` runs them; elsewhere they are skipped, as Ray is no dependency of the tests.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import protomark as pm
from conftest import protomark
from distributed_scene import (
    METADATA,
    content,
    joined,
    one_process,
    session,
    shard_maps,
    write_sessions,
)
from protomark.distributed import build, plan
from protomark.tracks.file import Tracks

ray = pytest.importorskip("ray")
cluster_utils = pytest.importorskip("ray.cluster_utils")

MEMORY = 300.0
PROTOTYPE_BYTES = 13_000  # far more than it takes, so that there are many shards
NODE = {"num_cpus": 1, "object_store_memory": 100_000_000}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    cluster = cluster_utils.Cluster(initialize_head=True, head_node_args=NODE)
    ray.init(address=cluster.address, log_to_driver=False)
    yield cluster
    ray.shutdown()
    cluster.shutdown()


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan, "PROTOTYPE_BYTES", PROTOTYPE_BYTES)


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_sessions(tmp_path_factory.mktemp("sessions"))


@pytest.fixture(scope="module")
def expected(
    cluster: Any, sessions: list[Path], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, bytes]:
    """What one node writes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "PROTOTYPE_BYTES", PROTOTYPE_BYTES)
        folder = tmp_path_factory.mktemp("expected") / "city"
        built(sessions, folder)
    return content(folder)


def built(sources: Any, folder: Path, **options: Any) -> dict[str, Any]:
    options = {"memory": MEMORY, "metadata": METADATA, "seal": False, "piece": 7001} | options
    facts = build(sources, folder, **options)
    run: dict[str, Any] = facts["run"]
    return run


def test_shards_are_the_map_of_one_process(
    sessions: list[Path], expected: dict[str, bytes], tmp_path: Path
) -> None:
    folder = tmp_path / "city"
    folder.mkdir()
    for name, data in expected.items():
        (folder / name).write_bytes(data)
    one = one_process(sessions, tmp_path / "one.pmk")
    assert joined(folder, tmp_path / "joined.pmk") == (tmp_path / "one.pmk").read_bytes()
    city = pm.ShardedMap(folder)
    city.verify()
    assert len(city.shards) > 6
    for shard, scene in zip(city.shards, shard_maps(folder), strict=True):
        ids = one.ids[(one.ids >= shard.ids[0]) & (one.ids <= shard.ids[1])]
        part = one.part(ids)
        part.metadata = scene.metadata
        part.save(tmp_path / "part.pmk")
        assert (tmp_path / "part.pmk").read_bytes() == expected[f"{shard.name}.pmk"]
    queries = session(500, 9).descriptors[:50]
    for found, right in zip(city.search(queries, 3), one.search(queries, 3), strict=True):
        assert np.array_equal(found, right)
    places = json.loads(city.metadata["places"])
    assert [name for name, _, _ in places] == [path.name for path in sessions]
    # Order counts where a landmark is seen more than 255 times, so it was kept.
    tracks = Tracks.load(sessions[0])
    rows = tracks.observations[::-1]
    other = pm.PrototypeMap(one.encoder, one.dim, one.appearance_bits)
    other.add(tracks.landmark_of_keypoint[rows], tracks.descriptors[rows])
    often = int(tracks.landmark_ids[5])
    assert not np.array_equal(other.appearances(often), one.appearances(often))


def test_any_number_of_nodes_order_and_pieces(
    cluster: Any, sessions: list[Path], expected: dict[str, bytes], tmp_path: Path
) -> None:
    for nodes, sources, piece in (
        (2, sessions[::-1], 7001),
        (4, sessions, 2500),
        (4, [sessions[i] for i in (1, 0, 2)], None),
    ):
        while len([node for node in ray.nodes() if node["Alive"]]) < nodes:
            cluster.add_node(**NODE)
        run = built(sources, tmp_path / "city", piece=piece)
        assert content(tmp_path / "city") == expected
        assert run["shards_taken_over"] == run["retries"] == 0


TITLES = [f"ray::{name}".encode() for name in ("encode_piece", "write_shard", "count")]


def workers_of(cluster: Any) -> list[int]:
    """Processes of this cluster's workers that are at work."""
    raylets = {node.all_processes["raylet"][0].process.pid for node in cluster.list_all_nodes()}
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            title = (path / "cmdline").read_bytes().partition(b"\0")[0].strip()
            if parent in raylets and title in TITLES:
                found.append(int(path.name))
    return found


@contextlib.contextmanager
def meanwhile(action: Callable[[], None], every: float) -> Iterator[None]:
    stop = threading.Event()

    def repeat() -> None:
        while not stop.wait(every):
            action()

    thread = threading.Thread(target=repeat)
    thread.start()
    yield
    stop.set()
    thread.join()


def test_killed_workers(
    cluster: Any, sessions: list[Path], expected: dict[str, bytes], tmp_path: Path
) -> None:
    killed = []

    def kill() -> None:
        if len(killed) < 4 and (workers := workers_of(cluster)):
            killed.append(random.choice(workers))
            with contextlib.suppress(ProcessLookupError):
                os.kill(killed[-1], signal.SIGKILL)

    with meanwhile(kill, 0.5):
        while not killed:  # a fast machine may be done before
            built(sessions, tmp_path / "city", piece=300)
    assert content(tmp_path / "city") == expected


def test_a_removed_node(
    cluster: Any, sessions: list[Path], expected: dict[str, bytes], tmp_path: Path
) -> None:
    node = cluster.add_node(**NODE)
    removed = []

    def remove() -> None:
        if not removed and any((tmp_path / "city" / ".build").glob("*.json")):
            removed.append(node)
            cluster.remove_node(node, allow_graceful=False)

    with meanwhile(remove, 0.05):
        built(sessions, tmp_path / "city", piece=500)
    assert removed
    assert content(tmp_path / "city") == expected


DRIVER = """
import sys
import protomark as pm
from protomark.distributed import build, plan
plan.PROTOTYPE_BYTES = int(sys.argv[1])
metadata = {"created": "2026-12-01T01:01:01Z", "frame": "metres"}
build(sys.argv[4:], sys.argv[3], ray=sys.argv[2], memory=300, metadata=metadata, seal=False)
"""


def test_a_killed_driver(
    cluster: Any, sessions: list[Path], expected: dict[str, bytes], tmp_path: Path
) -> None:
    folder = tmp_path / "city"
    built(sessions[:1], folder)
    before = content(folder)
    first = pm.ShardedMap(folder)
    command = [sys.executable, "-c", DRIVER, str(PROTOTYPE_BYTES), cluster.address, folder]
    driver = subprocess.Popen([*map(str, command), *map(str, sessions)])
    while not any(len(path.stem) == 64 for path in (folder / ".build").glob("*.json")):
        assert driver.poll() is None
        time.sleep(0.02)
    driver.kill()
    driver.wait()
    now = {name: data for name, data in content_if_file(folder).items() if name in before}
    assert now == before  # the last whole version
    # The time of the build that was cut is that of the map.
    run = built(sessions, folder, resume=True, metadata=METADATA | {"created": "x"})
    assert run["shards_taken_over"] >= 1
    done = pm.ShardedMap(folder)
    assert done.metadata["created"] == "2026-12-01T01:01:01Z"
    built(sessions, tmp_path / "whole", metadata=dict(METADATA, created="2026-12-01T01:01:01Z"))
    assert content(folder) == content(tmp_path / "whole")
    first.refresh()
    assert len(first) == len(done)


def content_if_file(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_a_full_disk(cluster: Any, sessions: list[Path], tmp_path: Path) -> None:
    folder = Path(tempfile.mkdtemp(prefix="protomark_disk_"))
    mount = ["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("no right to mount a tmpfs")
    try:
        built(sessions[1:2], folder / "city")
        before = content(folder / "city")
        with pytest.raises(OSError, match=r"city/.build/\S*pmk\S* .*No space left on device"):
            built(sessions, folder / "city")
        assert {
            name: data for name, data in content_if_file(folder / "city").items() if name in before
        } == before
        assert len(pm.ShardedMap(folder / "city").search(session(500, 1).descriptors[:5])[0])
        subprocess.run([*mount[:4], "remount,size=60m", *mount[5:]], check=True)
        built(sessions, folder / "city", resume=True)
        built(sessions, tmp_path / "whole")
        assert content(folder / "city") == content(tmp_path / "whole")
    finally:
        subprocess.run(["umount", str(folder)], check=True)
        folder.rmdir()


def test_a_session_that_is_added(
    cluster: Any, sessions: list[Path], expected: dict[str, bytes], tmp_path: Path
) -> None:
    folder = tmp_path / "city"
    built(sessions[:2], folder)
    before = content(folder)
    kept = tmp_path / "moved"
    sessions[0].rename(kept)  # what was built needs its sources no more
    try:
        run = built(sessions[2:], folder, add=True, metadata={"created": "2026-12-02T00:00:00Z"})
    finally:
        kept.rename(sessions[0])
    now = content(folder)
    assert all(now[name] == data for name, data in before.items() if name != "manifest.json")
    assert run["shards_written"] == len(now) - len(before)
    assert joined(folder, tmp_path / "joined.pmk") == one_process_bytes(sessions, tmp_path)
    with pytest.raises(ValueError, match=r"session2.freak.safetensors is in .*city already"):
        built(sessions[2:], folder, add=True)
    with pytest.raises(FileNotFoundError, match="holds no shards to add to"):
        built(sessions, tmp_path / "nowhere", add=True)


def one_process_bytes(paths: list[Path], folder: Path) -> bytes:
    one_process(paths, folder / "one.pmk")
    return (folder / "one.pmk").read_bytes()


def test_cubes_of_space(
    cluster: Any, sessions: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Are those of the map of one process, split."""
    folder = tmp_path / "city"
    built(sessions[2:], folder, cell_size=50.0)
    one = one_process(sessions[2:], tmp_path / "one.pmk")
    parts = one.split_by_space(50.0)
    shards = pm.ShardedMap(folder).shards
    assert len(shards) == len(parts) > 20
    found = [shard.name for shard in shards]
    for cell, part in parts.items():
        label = "_".join(map(str, cell or ()))
        (name,) = [name for name in found if name.startswith(f"shard-{label}-")]
        part.save(tmp_path / "part.pmk")
        assert (folder / f"{name}.pmk").read_bytes() == (tmp_path / "part.pmk").read_bytes()
    with pytest.raises(ValueError, match="several places with coordinates of their own"):
        built(sessions, folder, cell_size=50.0)
    monkeypatch.setattr(plan, "PROTOTYPE_BYTES", 100_000)
    with pytest.raises(ValueError, match=r"cube \S+ has [\d,]+ prototypes, more than the"):
        built(sessions[2:], folder, cell_size=5000.0)


def test_sealed_shards_and_object_storage(
    cluster: Any, sessions: list[Path], tmp_path: Path
) -> None:
    """Sources and output by URL; sealed shards beside the learning ones."""
    urls = [f"file://{path}" for path in sessions[:1]]
    built(urls, Path(tmp_path / "local"), seal=True)
    facts = build(urls, f"file://{tmp_path}/remote", memory=MEMORY, metadata=METADATA, piece=7001)
    assert content(tmp_path / "local") == content(tmp_path / "remote")
    assert facts["landmarks"] == len(pm.ShardedMap(tmp_path / "remote"))
    city = pm.ShardedMap(tmp_path / "local")
    assert city.tuned == pm.open(tmp_path / "local" / city.shards[0].answering.name).tuned
    assert all(shard.sealed and shard.learning for shard in city.shards)
    city.verify()


def test_images_become_tracks_first(cluster: Any, tmp_path: Path) -> None:
    from tracks_scene import write_sequence

    folder = write_sequence(tmp_path / "plane", count=5)
    built([folder], tmp_path / "city")
    assert joined(tmp_path / "city", tmp_path / "joined.pmk") == one_process_bytes(
        [folder], tmp_path
    )
    assert not (tmp_path / "city" / ".build").exists()


def test_what_is_refused(cluster: Any, sessions: list[Path], tmp_path: Path) -> None:
    broken = session(5000, 0)
    broken.landmark_of_keypoint = broken.landmark_of_keypoint.copy()
    broken.save(tmp_path / "good.safetensors")
    data = (tmp_path / "good.safetensors").read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(data[:-9])
    wrong = data.replace(np.int64(7 + 3 * 5).tobytes(), np.int64(8 + 3 * 5).tobytes(), 1)
    (tmp_path / "wrong.safetensors").write_bytes(wrong)
    latch = session(3000, 1)
    latch.descriptor, latch.descriptors = "latch", latch.descriptors[:, :32].copy()
    latch.save(tmp_path / "latch.safetensors")
    folder = tmp_path / "city"
    for sources, options, error, message in (
        (["cut.safetensors"], {}, ValueError, r"cut.safetensors: .* is cut off"),
        (["wrong.safetensors"], {}, ValueError, "landmark_ids lacks|not ascending"),
        (["latch.safetensors", "good.safetensors"], {}, ValueError, "choose an encoder for"),
        (["none.safetensors"], {}, FileNotFoundError, r"none.safetensors"),
        (["good.safetensors"], {"memory": 100}, ValueError, "a worker needs 200 MB or more"),
        (["good.safetensors"], {"memory": 1e9}, ValueError, "more than a node of the cluster has"),
        (["good.safetensors"], {"min_observations": 99999}, ValueError, "no landmark has 99999"),
        (["good.safetensors"] * 2, {}, ValueError, "is named twice"),
    ):
        with pytest.raises(error, match=message):
            built([tmp_path / name for name in sources], folder, **options)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "manifest.json").write_text('{"name": "a web page"}')
    with pytest.raises(ValueError, match=r"is no manifest of shards"):
        built(sessions, tmp_path / "other")
    built([tmp_path / "good.safetensors"], folder)
    with pytest.raises(ValueError, match="is of encoder 'freak' with 48 numbers, not of 'freak'"):
        built(sessions[:1], folder, add=True, dim=16)
    for url in ("s3://key:secret@bucket/a.freak.safetensors?token=secret", "nosuch://secret@x/a"):
        with pytest.raises((ValueError, OSError, ModuleNotFoundError)) as failed:
            built([url], folder)
        assert "secret" not in str(failed.value)


def test_the_command(sessions: list[Path], cluster: Any, tmp_path: Path) -> None:
    """On the cluster that this process is connected to."""
    folder = tmp_path / "city"
    words = ("build", *sessions[::-1], "-o", folder, "--ray", "auto", "--memory", 300, "--no-seal")
    done = protomark(*words, "--json", tmp_path / "facts.json")
    assert done.returncode == 0, done.stderr
    assert "per second of a worker" in " ".join(done.stdout.split())
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts["run"]["observations"] == sum(s["observations"] for s in facts["sources"])
    assert len(pm.ShardedMap(folder)) == facts["landmarks"]
    shown = protomark("info", folder, "--verify")
    assert "all right" in shown.stdout
    for words, message in (
        (("--memory", 300), "--memory is for shards: add --ray local"),
        (("--add",), "--add is for shards"),
    ):
        done = protomark("build", sessions[0], "-o", tmp_path / "a.pmk", *words)
        assert done.returncode == 1
        assert message in done.stderr


def test_no_cluster_there(tmp_path: Path) -> None:
    from protomark.distributed.cluster import _check_answers

    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        threading.Thread(target=lambda: server.accept()[0].sendall(b"HTTP/1.1 400\r\n")).start()
        with pytest.raises(ConnectionError, match="something else listens there"):
            _check_answers(f"127.0.0.1:{port}")
    began = time.monotonic()
    with pytest.raises(ConnectionError, match="refused"):
        _check_answers(f"127.0.0.1:{port}")
    assert time.monotonic() - began < 5
    with pytest.raises(ValueError, match="is no address: give local, auto or HOST:PORT"):
        _check_answers("local host")
    shutil.rmtree(tmp_path)
