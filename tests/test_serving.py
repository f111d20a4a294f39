"""The service `protomark serve`, as clients see it."""

from __future__ import annotations

import io
import json
import signal
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import protomark as pm
from conftest import protomark

pytest.importorskip("fastapi_offline")

from prometheus_client.parser import text_string_to_metric_families

from protomark.geometry.pose import camera_centers, pose_error, rotation_from_quaternion
from serving_client import IMAGES, Frame, Server, form, reply_of, sample_map

CAMERA = "PINHOLE 640 480 500 500 320 240"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("serving") / "toy.pmk"
    sample_map(path)
    return path


@pytest.fixture(scope="module")
def server(scene: Path) -> Iterator[Server]:
    with Server((scene, "--threads", 2, "--max-megabytes", 2, "--max-megapixels", 3)) as running:
        yield running


@pytest.fixture(scope="module")
def frame() -> Frame:
    return Frame.of(3)


def pose_of(answer: Any) -> Any:
    pose = answer["cam_from_world"]
    rotation = rotation_from_quaternion(np.array(pose["quaternion"]))
    return np.column_stack([rotation, pose["translation"]])


def test_every_form_of_features_gets_what_a_localizer_finds(
    server: Server, scene: Path, frame: Frame
) -> None:
    camera = str(frame.camera)
    found = pm.Localizer(scene).localize_features(frame.keypoints, frame.descriptors, frame.camera)
    body, kind = form({"features": frame.safetensors()}, {"camera": camera, "details": "true"})
    replies = [
        server.localize_json(**frame.json(), details=True),
        server.localize_json(**{**frame.json(), "camera": camera}, details=True),
        server.localize(frame.safetensors(), camera=camera, details="true"),
        server.localize(body, kind),
    ]
    for reply in replies:
        assert reply.status == 200, reply.text
        answer = reply.json
        assert found.cam_from_world is not None
        assert found.covariance is not None
        np.testing.assert_allclose(pose_of(answer), found.cam_from_world, atol=1e-12)
        np.testing.assert_allclose(
            answer["center"], camera_centers(found.cam_from_world), atol=1e-12
        )
        np.testing.assert_allclose(answer["covariance"], found.covariance, rtol=1e-9)
        assert answer["confidence"] == pytest.approx(found.confidence)
        assert answer["accepted"]
        assert (answer["inliers"], answer["matches"]) == (found.inliers, found.evidence.matches)
        assert answer["details"]["landmarks"] == found.landmarks.tolist()
        np.testing.assert_array_equal(answer["details"]["pixels"], found.pixels)
        assert list(answer["seconds"]) == ["wait", "decode", "encode", "search", "pose", "total"]
        assert (answer["reason"], answer["place"], answer["warnings"]) == ("", "", [])
    assert pose_error(pose_of(answer), frame.true_pose)[1] < 1
    # Without a camera it is the map's, and what was not asked for is not sent.
    answer = server.localize(frame.safetensors()).json
    assert answer["camera"]["params"] == pytest.approx(frame.camera.params)
    assert answer["details"] is None


def test_an_answer_is_the_prior_of_the_next_request(server: Server, frame: Frame) -> None:
    message = frame.json()
    first = server.localize_json(**message).json
    settings: dict[str, Any] = {"prior_distance": 0.1, "prior_degrees": 5}
    pose = first["cam_from_world"]
    again = server.localize_json(**message, prior=pose, **settings).json
    line = " ".join(map(str, [*pose["quaternion"], *pose["translation"]]))
    by_line = server.localize(frame.safetensors(), prior=line, **settings).json
    np.testing.assert_allclose(pose_of(again), pose_of(first), atol=1e-3)
    np.testing.assert_allclose(pose_of(again), pose_of(by_line), atol=1e-9)
    beyond = {"quaternion": [1, 0, 0, 0], "translation": [0, 0, -1000]}
    assert server.localize_json(**message, prior=beyond).json["cam_from_world"] is None


def test_no_pose_is_an_answer_with_a_reason(server: Server, frame: Frame) -> None:
    few = replace(frame, keypoints=frame.keypoints[:2], descriptors=frame.descriptors[:2])
    answer = server.localize_json(**few.json()).json
    assert (answer["cam_from_world"], answer["confidence"]) == (None, 0.0)
    assert not answer["accepted"]
    assert answer["reason"] == "only 2 keypoints: blurred, dark or empty"
    # A doubtful camera is named in the answer, to the second client as to the first.
    for _ in range(2):
        message = {**frame.json(), "camera": "PINHOLE 1280 964 900 900 300 200"}
        (warning,) = server.localize_json(**message).json["warnings"]
        assert "principal point is far from the middle" in warning


@pytest.mark.skipif(not IMAGES.is_dir(), reason="needs the images of the sample")
def test_images(server: Server, scene: Path) -> None:
    path = IMAGES / "00010.jpg"
    photo = path.read_bytes()
    found = pm.Localizer(scene).localize(path)
    replies = [
        server.localize(photo, "image/jpeg"),
        server.localize(photo, "application/x-www-form-urlencoded"),  # curl --data-binary
        server.localize(*form({"image": photo}, {})),
        server.localize(photo, camera="SIMPLE_RADIAL:923.790963292,640,482,0.0190706093685"),
    ]
    for reply in replies:
        assert found.cam_from_world is not None
        np.testing.assert_allclose(pose_of(reply.json), found.cam_from_world, atol=1e-12)
        assert reply.json["seconds"]["features"] > 0
    rough = server.localize(photo, camera="SIMPLE_PINHOLE:1000,640,482", focal_length="rough").json
    assert rough["camera"]["params"][0] == pytest.approx(924, rel=0.05)


def test_the_focal_length_of_exif_data_is_refined(server: Server) -> None:
    image = pytest.importorskip("PIL.Image")
    exif = image.Exif()
    exif[0x8769] = {0xA405: 34}  # focal length of 35 mm film, by the image's diagonal 43.3 mm
    noise = np.random.default_rng(0).integers(0, 256, (300, 400), np.uint8)
    file = io.BytesIO()
    image.fromarray(noise).save(file, "jpeg", exif=exif)
    answer = server.localize(file.getvalue()).json
    assert answer["camera"]["params"][0] == pytest.approx(34 / 43.27 * 500, rel=0.01)


def png(width: int, height: int) -> bytes:
    file = io.BytesIO()
    pytest.importorskip("PIL.Image").new("L", (width, height)).save(file, "png")
    return file.getvalue()


GOOD = {"keypoints": [[1, 2]], "descriptors": "A" * 86 + "==", "camera": CAMERA}


@pytest.mark.parametrize(
    ("body", "settings", "status", "sentence"),
    [
        (b"", {}, 422, "the body is empty"),
        (b"no image", {}, 422, "no image of a known format (JPEG, PNG"),
        (b"GIF89a" + bytes(99), {}, 422, "no image of a known format"),
        (png(9, 9)[:60], {}, 422, "truncated"),
        (png(2000, 2000), {}, 413, "2000 x 2000 pixels, more than 3 million: scale it down"),
        (bytes(2_000_001), {}, 413, "larger than 2 MB: send a smaller image"),
        (png(9, 9), {"camera": "PINHOLE:1,2"}, 422, "PINHOLE has 4 parameters, not 2"),
        (png(9, 9), {"camera": "/etc/passwd"}, 422, "lacks numbers"),
        (png(9, 9), {"camera": CAMERA}, 422, "has 9 x 9 pixels, but its camera 640 x 480"),
        (png(9, 9), {"prior": "1 0 0 0 0 0"}, 422, "prior: write a pose as QW QX QY QZ TX TY TZ"),
        (png(9, 9), {"prior": "1 1 0 0 0 0 0"}, 422, "the length of quaternion"),
        (png(9, 9), {"prior_distance": "-1"}, 422, "prior_distance: input should be greater"),
        (png(9, 9), {"focal": "known"}, 422, "focal: extra inputs are not permitted"),
        (png(9, 9), {"focal_length": "x"}, 422, "focal_length: input should be 'known', 'rough'"),
        (b"{", {}, 422, "the JSON body: invalid JSON"),
        ({**GOOD, "camera": None}, {}, 422, "1 keypoints"),
        ({**GOOD, "descriptors": "AAAA"}, {}, 422, "3 bytes are not 64 for each of 1 keypoints"),
        ({**GOOD, "descriptors": "!"}, {}, 422, "descriptors: this is no base64"),
        ({**GOOD, "keypoints": [[1]]}, {}, 422, "keypoints.0.1: field required"),
        ({**GOOD, "keypoints": [[1, float("nan")]]}, {}, 422, "keypoints.0.1: input should be a f"),
        ({**GOOD, "keypoints": [[1, 9000]]}, {}, 422, "keypoints are (x, y) in pixels"),
        ({**GOOD, "camera": "PINHOLE:5,5,3,2"}, {}, 422, "has no size, which features need"),
        ({**GOOD, "camera": {"model": "X"}}, {}, 422, "camera.CameraMessage.width: field required"),
        (GOOD, {"details": "true"}, 422, "details is in the URL, but the body is JSON"),
        ({"keypoints": [[1, 2]] * 10001, "descriptors": "A" * 853420 + "A==="}, {}, 422, "base64"),
    ],
)
def test_what_is_refused(
    server: Server, body: Any, settings: dict[str, str], status: int, sentence: str
) -> None:
    kind = "application/json" if isinstance(body, dict) or body == b"{" else "image/png"
    data = json.dumps(body).encode() if isinstance(body, dict) else body
    reply = server.localize(data, kind, **settings)
    if body == {**GOOD, "camera": None}:  # the map's camera serves: one keypoint is no pose
        assert reply.json["reason"].startswith("only " + sentence)
        return
    assert (reply.status, sentence in reply.problem) == (status, True), reply.text


def test_what_is_refused_of_tensors_and_forms(server: Server, frame: Frame) -> None:
    from safetensors.numpy import save

    keypoints, descriptors = frame.keypoints, frame.descriptors
    many = np.zeros((10_001, 2))
    for tensors, status, sentence in (
        ({"keypoints": keypoints}, 422, "the features hold keypoints: name two tensors"),
        ({"keypoints": keypoints.astype(int), "descriptors": descriptors}, 422, "of a float type"),
        ({"keypoints": keypoints[1:], "descriptors": descriptors}, 422, "a row per keypoint"),
        ({"keypoints": keypoints + np.nan, "descriptors": descriptors}, 422, "not finite"),
        ({"keypoints": many, "descriptors": np.zeros((10_001, 64), np.uint8)}, 413, "than 10000"),
    ):
        reply = server.localize(save(tensors))
        assert (reply.status, sentence in reply.problem) == (status, True), reply.text
    torn = frame.safetensors()[:-8]
    assert "no safetensors file" in server.localize(torn).problem
    for files, texts, sentence in (
        ({}, {"camera": CAMERA}, "the form has no file"),
        ({"photo": b"x"}, {}, "the form has no file: name one `image`, or `features`"),
        ({"image": b"x", "features": b"x"}, {}, "Too many files"),
        ({"image": b"x"}, {"details": "maybe"}, "details: input should be a valid boolean"),
    ):
        reply = server.localize(*form(files, texts))
        assert (reply.status, sentence in reply.problem) == (422, True), reply.text
    body, kind = form({"image": b"x"}, {"camera": CAMERA})
    assert "camera is given twice" in server.localize(body, kind, camera=CAMERA).problem
    assert "cannot be read" in server.localize(b"--", "multipart/form-data").problem


def test_other_addresses(server: Server) -> None:
    assert server.get("/nothing").problem.startswith("there is nothing at this address: /docs")
    refused = server.get("/localize")
    assert (refused.status, refused.headers["allow"]) == (405, "POST")
    assert "takes only POST" in refused.problem
    page = server.get("/")
    assert "default-src 'none'" in page.headers["content-security-policy"]
    assert "http" not in page.text.replace("http-equiv", "")  # it asks nobody else
    docs = server.get("/docs").text
    assert "//" not in docs.replace("/static-offline-docs/", "").partition("<script>")[0]
    described = server.get("/openapi.json").json
    body = described["paths"]["/localize"]["post"]["requestBody"]["content"]
    assert list(body) == [
        *("multipart/form-data", "image/*", "application/octet-stream", "application/json")
    ]
    assert described["components"]["schemas"]["FeaturesMessage"]["required"] == [
        *("keypoints", "descriptors")
    ]
    picture = server.get("/map").json
    assert picture["landmarks"] == server.get("/health").json["landmarks"] == 3829
    (place,) = picture["places"]
    assert np.shape(place["landmarks"]) == (3829, 2)


def test_a_body_of_unknown_length_ends_at_the_limit(server: Server) -> None:
    endless = (bytes(50_000) for _ in range(100))
    connection = server.connect()
    connection.request("POST", "/localize", endless, encode_chunked=True, headers={})
    reply = reply_of(connection)
    assert (reply.status, "larger than 2 MB" in reply.problem) == (413, True)


def test_metrics(server: Server, frame: Frame) -> None:
    def figures() -> dict[Any, float]:
        text = server.get("/metrics").text
        families = list(text_string_to_metric_families(text))
        return {
            (sample.name, *sorted(sample.labels.values())): sample.value
            for family in families
            for sample in family.samples
        }

    before = figures()
    server.localize(frame.safetensors())
    server.localize(b"no image")
    after = figures()
    assert after["protomark_map_landmarks",] == 3829
    for name in (
        ("protomark_requests_total", "200", "pose"),
        ("protomark_requests_total", "422", "refused"),
        ("protomark_stage_seconds_count", "search"),
        ("protomark_confidence_count",),
    ):
        assert after[name] - before.get(name, 0) == 1, name
    count = ("protomark_request_seconds_count",)
    assert after[count] - before[count] == 2
    assert (after["protomark_requests_in_progress",], after["protomark_requests_waiting",]) == (
        0,
        0,
    )


def test_health_answers_under_load(server: Server, frame: Frame) -> None:
    body, statuses, ended = frame.safetensors(), [], time.monotonic() + 3

    def ask() -> None:
        while time.monotonic() < ended:
            statuses.append(server.localize(body).status)

    threads = [threading.Thread(target=ask) for _ in range(6)]
    for thread in threads:
        thread.start()
    waits = []
    while time.monotonic() < ended:
        began = time.monotonic()
        assert server.get("/health").json["status"] == "ok"
        waits.append(time.monotonic() - began)
        time.sleep(0.05)
    for thread in threads:
        thread.join()
    assert set(statuses) == {200}
    assert np.median(waits) < 0.25


def half_sent(server: Server, body: bytes) -> Any:
    """A connection over which half of a request was sent."""
    connection = server.connect()
    connection.putrequest("POST", "/localize")
    connection.putheader("Content-Length", str(len(body)))
    connection.endheaders(body[: len(body) // 2])
    return connection


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_full_queue_slow_bodies_and_the_end(scene: Path, frame: Frame, number: int) -> None:
    body = frame.safetensors()
    limits = ("--threads", 1, "--queue", 0, "--timeout", 3 if number == signal.SIGINT else 30)
    with Server((scene, *limits)) as server:
        connection = half_sent(server, body)
        deadline = time.monotonic() + 20
        while not server.get("/health").json["in_progress"] and time.monotonic() < deadline:
            time.sleep(0.02)
        busy = server.localize(body)
        assert (busy.status, busy.headers["retry-after"]) == (503, "1")
        assert "the server is busy (0 requests wait already): try again in 1 s" in busy.problem
        if number == signal.SIGINT:
            slow = reply_of(connection)
            assert (slow.status, "did not arrive within 3 s" in slow.problem) == (408, True)
            connection = half_sent(server, body)
            time.sleep(0.3)
        # A signal lets no new request in, and the one in progress end.
        server.process.send_signal(number)
        time.sleep(0.3)
        with pytest.raises(OSError, match="refused"):
            server.get("/health")
        connection.send(body[len(body) // 2 :])
        reply = reply_of(connection)
        assert (reply.status, reply.json["confidence"] > 0.9) == (200, True)
        assert server.stop(0) == 0
        *lines, last = server.log.splitlines()
        assert last == "all requests are answered; stopped"
        # Nothing but size, time and outcome.
        for line in lines:
            assert line.split(" ", 1)[1].startswith(("200 pose, ", "408 refused, ", "503 busy, "))
        assert len(lines) == (2 if number == signal.SIGTERM else 3)


def test_what_cannot_be_served(scene: Path, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        done = protomark("serve", scene, "--port", taken.getsockname()[1])
    assert (done.returncode, "name others with --host, --port" in done.stderr) == (1, True)
    bare = pm.PrototypeMap(pm.Encoder.load("freak"), 32)
    bare.save(tmp_path / "bare.pmk")
    done = protomark("serve", tmp_path / "bare.pmk")
    assert (done.returncode, "none of the map's 0 landmarks has a position" in done.stderr) == (
        1,
        True,
    )
