"""A real server in a process of its own, and requests to it."""

from __future__ import annotations

import http.client
import json
import signal
import subprocess
import sys
from base64 import b64encode
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

import protomark as pm
from conftest import DATA
from protomark import sample
from protomark.evaluation.frames import QueryFrame
from protomark.geometry.camera import Camera
from protomark.maps.build import build_map
from protomark.maps.cameras import KEY, cameras_text

IMAGES = DATA / "toy" / "images"  # those that the sample was made from


@dataclass
class Reply:
    """What came back."""

    status: int
    text: str
    headers: dict[str, str]

    @property
    def json(self) -> Any:
        return json.loads(self.text)

    @property
    def problem(self) -> str:
        """The sentence of an error."""
        assert self.status >= 400
        assert "Traceback" not in self.text
        sentence: str = self.json["detail"]
        assert list(self.json) == ["detail"]
        assert "\n" not in sentence
        return sentence


@dataclass
class Server:
    """`protomark serve` with these arguments, at a free port."""

    arguments: tuple[object, ...]
    process: subprocess.Popen[str] = field(init=False)
    address: str = ""
    log: str = ""

    def __enter__(self) -> Server:
        words = [sys.executable, "-m", "protomark", "serve", *map(str, self.arguments)]
        self.process = subprocess.Popen([*words, "--port", "0"], stderr=subprocess.PIPE, text=True)
        assert self.process.stderr is not None
        first = self.process.stderr.readline()
        assert first.startswith("http://127.0.0.1:"), first + self.process.stderr.read()
        self.address = urlsplit(first.split()[0]).netloc
        return self

    def __exit__(self, *error: object) -> None:
        with suppress(subprocess.TimeoutExpired):
            self.stop()
        self.process.kill()

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Send a signal, 0 for none, and wait for the end; returns the exit code."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        self.log = self.log or self.process.communicate(timeout=60)[1]
        return self.process.returncode

    def connect(self) -> http.client.HTTPConnection:
        return http.client.HTTPConnection(self.address, timeout=60)

    def get(self, path: str) -> Reply:
        return self.request("GET", path)

    def request(
        self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None
    ) -> Reply:
        connection = self.connect()
        connection.request(method, path, body, headers or {})
        return reply_of(connection)

    def localize(self, body: bytes, kind: str = "", **settings: object) -> Reply:
        """Post a body of this content type, with settings in the URL."""
        path = "/localize" + (f"?{urlencode(settings)}" if settings else "")
        return self.request("POST", path, body, {"Content-Type": kind} if kind else {})

    def localize_json(self, **message: Any) -> Reply:
        return self.localize(json.dumps(message).encode(), "application/json")


def reply_of(connection: http.client.HTTPConnection) -> Reply:
    reply = connection.getresponse()
    return Reply(reply.status, reply.read().decode(), dict(reply.getheaders()))


def form(files: dict[str, bytes], texts: dict[str, str]) -> tuple[bytes, str]:
    """A form as browsers send it, and its content type."""
    end = b"0123456789abcdef"
    parts = [
        *(
            b'name="%s"; filename="x"\r\nContent-Type: image/jpeg\r\n\r\n%s' % (name.encode(), data)
            for name, data in files.items()
        ),
        *(b'name="%s"\r\n\r\n%s' % (name.encode(), text.encode()) for name, text in texts.items()),
    ]
    disposition = b"--%s\r\nContent-Disposition: form-data; " % end
    body = b"".join(disposition + part + b"\r\n" for part in parts) + b"--%s--\r\n" % end
    return body, f"multipart/form-data; boundary={end.decode()}"


@dataclass(frozen=True)
class Frame:
    """Features of a keyframe of the sample."""

    keypoints: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    camera: Camera
    true_pose: NDArray[np.float64]

    @classmethod
    def of(cls, keyframe: int) -> Frame:
        frame = QueryFrame.of(sample.load(), keyframe)
        return cls(frame.keypoints, frame.descriptors, frame.camera, frame.cam_from_world)

    def safetensors(self) -> bytes:
        return save({"keypoints": self.keypoints, "descriptors": self.descriptors})

    def json(self) -> dict[str, Any]:
        return {
            "keypoints": self.keypoints.tolist(),
            "descriptors": b64encode(self.descriptors.tobytes()).decode(),
            "camera": self.camera.as_dict(),
        }


def sample_map(path: Path) -> pm.PrototypeMap:
    """A map of the sample with its camera, saved."""
    tracks = sample.load()
    scene = build_map(tracks, pm.Encoder.load("freak"), 32)
    scene.metadata = {KEY: cameras_text(tracks.cameras.values())}
    scene.save(path)
    return scene
