"""The page of `protomark serve` in headless Chromium, and what it draws.

Needs `pip install playwright` and a Chromium (apt-get install chromium); skipped without them.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("fastapi_offline")

from protomark.maps.places import Place
from protomark.serving.top_view import keyframe_poses, top_view
from serving_client import IMAGES, Frame, Server, sample_map
from tracks_scene import PINHOLE, poses, write_model

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    path = tmp_path_factory.mktemp("page") / "toy.pmk"
    sample_map(path)
    with Server((path,)) as running:
        yield running


@pytest.fixture
def page(server: Server) -> Iterator[Any]:
    """The page, in a browser that reports requests to others and errors of scripts."""
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("needs Chromium")
    errors: list[str] = []
    asked: list[str] = []
    with playwright.sync_playwright() as run:
        browser = run.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": 1100, "height": 800})
        tab.on("pageerror", lambda error: errors.append(str(error)))
        tab.on("request", lambda r: r.url.startswith(("http", "ws")) and asked.append(r.url))
        tab.goto(f"http://{server.address}/")
        yield tab
        browser.close()
    assert errors == []
    assert [url for url in asked if not url.startswith(f"http://{server.address}/")] == []


def coloured(tab: Any, name: str) -> int:
    """Number of pixels of the map in a colour of the page."""
    script = """name => {
      const probe = document.createElement("canvas").getContext("2d");
      probe.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--" + name);
      probe.fillRect(0, 0, 1, 1);
      const want = probe.getImageData(0, 0, 1, 1).data, canvas = document.getElementById("map");
      const all = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
      let count = 0;
      for (let i = 0; i < all.length; i += 4)
        count += [0, 1, 2, 3].every(j => Math.abs(all[i + j] - want[j]) < 8);
      return count;
    }"""
    return int(tab.evaluate(script, name))


@pytest.mark.skipif(not IMAGES.is_dir(), reason="needs the images of the sample")
def test_a_photo_that_is_chosen_or_dropped_is_seen_in_the_map(page: Any) -> None:
    page.get_by_text("The map has 3,829 landmarks.").wait_for()
    assert coloured(page, "dot") > 1000
    assert coloured(page, "red") == 0
    # By keyboard: the first key stops at the link, the second at the file.
    page.keyboard.press("Tab")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "file"
    page.set_input_files("#file", IMAGES / "00010.jpg")
    page.get_by_text("Found.", exact=True).wait_for()
    assert coloured(page, "red") > 100
    assert coloured(page, "ours") > 500
    facts = page.inner_text("#facts")
    assert "Confidence\t1.000" in facts
    label = page.get_attribute("#map", "aria-label")
    assert label.startswith("The map from above, with the camera at 1.07")
    # What the sample's own keyframe says.
    data = (IMAGES / "00020.jpg").read_bytes()
    page.evaluate(
        """bytes => {
          const data = new DataTransfer();
          data.items.add(new File([new Uint8Array(bytes)], "x.jpg", {type: "image/jpeg"}));
          document.body.dispatchEvent(new DragEvent("drop", {bubbles: true, dataTransfer: data}));
        }""",
        list(data),
    )
    page.get_by_text("Looking for the place").wait_for()
    page.get_by_text("Found.", exact=True).wait_for()
    assert page.get_attribute("#map", "aria-label") != label


def test_the_page_says_what_is_wrong(page: Any, tmp_path: Path) -> None:
    (tmp_path / "text.jpg").write_text("no image")
    page.set_input_files("#file", tmp_path / "text.jpg")
    page.get_by_text("the body is no image of a known format").wait_for()
    noise = np.random.default_rng(0).integers(0, 256, (240, 320), np.uint8)
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    page.set_input_files("#file", tmp_path / "noise.png")
    page.get_by_text("Not found").or_(page.get_by_text("Perhaps here")).wait_for()
    page.fill("#camera", "PINHOLE:1,2")
    page.press("#camera", "Enter")
    page.get_by_text("PINHOLE has 4 parameters, not 2").wait_for()


def test_places_have_planes_of_their_own(tmp_path: Path) -> None:
    scene = sample_map(tmp_path / "toy.pmk")
    ids = scene.ids
    middle = int(ids[1000])
    places = [Place("a", 0, middle), Place("b", middle + 1, int(ids[-1]))]
    a, b = top_view(scene, places, None)
    assert (a["name"], len(a["landmarks"]), len(b["landmarks"])) == ("a", 1001, len(ids) - 1001)
    for view in (a, b):
        np.testing.assert_allclose(
            np.array(view["plane"]) @ np.transpose(view["plane"]), np.eye(2), atol=1e-9
        )
        assert abs(np.median(view["landmarks"], axis=0)).max() < 0.5
    # A folder of `map` knows its cameras, and so what is up.
    assert keyframe_poses(tmp_path) is None
    write_model(tmp_path / "sparse", PINHOLE, [f"{i}.png" for i in range(5)], poses(5))
    (view,) = top_view(scene, [], keyframe_poses(tmp_path))
    assert len(view["keyframes"]) == 5
    assert Frame.of(0).camera.width == 1280
