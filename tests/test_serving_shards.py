"""`protomark serve` of maps in shards, in one process and by replicas of Ray Serve."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from conftest import protomark

pytest.importorskip("fastapi_offline")
from protomark.maps.shards import Manifest
from protomark.maps.split import split_file
from serving_client import Frame, Reply, Server, sample_map


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shards")
    sample_map(folder / "toy.pmk")
    split_file(folder / "toy.pmk", folder / "parts", parts=4)
    return folder


def fields(reply: Reply) -> dict[str, object]:
    """An answer without its times."""
    assert reply.status == 200, reply.text
    return {name: value for name, value in reply.json.items() if name != "seconds"}


def test_shards_answer_as_one_map_while_they_come_and_go(folder: Path, tmp_path: Path) -> None:
    parts = shutil.copytree(folder / "parts", tmp_path / "parts")
    manifest = Manifest.load(parts)
    body = Frame.of(3).safetensors()
    with Server((folder / "toy.pmk",)) as one, Server((parts,)) as several:
        whole = fields(one.localize(body, details="true"))
        assert fields(several.localize(body, details="true")) == whole
        replies: list[Reply] = []
        stopped = threading.Event()

        def ask() -> None:
            while not stopped.is_set():
                replies.append(several.localize(body))

        thread = threading.Thread(target=ask)
        thread.start()
        for shards in (manifest.shards[:2], manifest.shards):
            Manifest(
                **{**vars(manifest), "shards": shards},
            ).save(parts)
            landmarks = sum(shard.landmarks for shard in shards)
            deadline = time.monotonic() + 20
            while several.get("/health").json["landmarks"] != landmarks:
                assert time.monotonic() < deadline
                time.sleep(0.1)
        # A broken manifest changes nothing.
        (parts / "manifest.json").write_text("{}")
        time.sleep(2.5)
        stopped.set()
        thread.join()
        assert {reply.status for reply in replies} == {200}
        assert fields(several.localize(body, details="true")) == whole
        several.stop()
        assert "the map stays as it was" in several.log
        # A shard that cannot be read is the operator's to hear of, by name, not the client's.
        (parts / "manifest.json").write_text(manifest.text())
    with Server((parts,)) as torn:
        shard = parts / manifest.shards[3].answering.name
        shard.write_bytes(shard.read_bytes()[:-100])
        reply = torn.localize(body)
        assert (reply.status, reply.headers["retry-after"]) == (503, "5")
        assert reply.problem == "the map cannot be read now: try again in 5 s"
        torn.stop()
        assert "but its manifest says" in torn.log


def test_replicas_answer_as_one_map_although_they_are_killed(folder: Path) -> None:
    ray = pytest.importorskip("ray")
    pytest.importorskip("ray.serve")
    from protomark.serving.replicas import replicated

    scene = pm.open(folder / "toy.pmk")
    codes = scene.encoder.encode(Frame.of(3).descriptors, scene.dim)
    expected = scene.search_codes(codes, 3)
    some = scene.ids[::7]
    among = scene.search_codes(codes, 3, among=some)
    ray.init(address="local", num_cpus=4, include_dashboard=False, log_to_driver=False)
    try:
        with replicated(folder / "parts", "local", 2) as several:
            assert len(several._handles) == 2
            for found, true in (
                (several.search_codes(codes, 3), expected),
                (several.search_codes(codes, 3, among=some), among),
            ):
                for a, b in zip(found, true, strict=True):
                    np.testing.assert_array_equal(a, b)
            processes = {h.process.remote().result() for h in several._handles for _ in range(20)}
            assert len(processes) > 2
            for number in processes:
                os.kill(number, signal.SIGKILL)
                ids, distances = several.search_codes(codes, 3)
                np.testing.assert_array_equal(ids, expected[0])
                np.testing.assert_array_equal(distances, expected[1])
    finally:
        ray.shutdown()


def test_a_cluster_that_does_not_answer(folder: Path) -> None:
    pytest.importorskip("ray.serve")
    done = protomark("serve", folder / "parts", "--ray", "127.0.0.1:1")
    assert (done.returncode, "no Ray cluster answers at 127.0.0.1:1" in done.stderr) == (1, True)
    done = protomark("serve", folder / "parts", "--replicas", 3)
    assert (done.returncode, "--replicas is of --ray" in done.stderr) == (1, True)
