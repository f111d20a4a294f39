"""Measures a `Localizer` on a large sealed map: opening, memory, and seconds per frame.

python benchmarks/scripts/localizer_memory.py MAP TRACKS... [--landmarks 10000000]

MAP is made if it is not there, of synthetic landmarks (see `protomark_bench.speed.landmarks`) with
32 numbers of 8 bits, an index and 16-bit positions. Each frame has 1,000 keypoints at another place
of the map: 600 see one landmark each, 400 see nothing that the camera does. Private memory is what
the process cannot share or give back (RssAnon), resident is all (VmRSS), above that of the process
before it opened the map.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.cli.terminal import progress_bar
from protomark.geometry.camera import Camera
from protomark.geometry.pose import camera_centers
from protomark.localization.localizer import Localizer
from protomark.progress import tracked
from protomark_bench.report import ReportTable
from protomark_bench.speed.landmarks import RealLandmarks, SyntheticLandmarks

DIM, THREADS, RECALL = 32, 2, 0.98
CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
KEYPOINTS, SEEN = 1000, 600
# A place holds this many landmarks, in a box before its camera.
PLACE, GRID = 2000, 70
_PART = 1 << 20


def positions(first: int, count: int) -> NDArray[np.float64]:
    """Positions (count, 3) of landmarks from `first` on."""
    rng = np.random.default_rng([1, first])
    places = np.arange(first, first + count) // PLACE
    return rng.uniform((-2.5, -2, 4), (2.5, 2, 8), (count, 3)) + center(places)


def center(places: NDArray[np.int64] | np.int64) -> NDArray[np.float64]:
    """Where (n, 3) the camera stands at these places (n,), which form a grid."""
    row, column = np.divmod(places, GRID)
    return np.asarray(10.0 * np.stack([column, np.zeros_like(row), row], axis=-1))


def learning_map(
    synthetic: SyntheticLandmarks, encoder: pm.Encoder, first: int, last: int
) -> pm.PrototypeMap:
    """A learning map of synthetic landmarks from `first` to before `last`."""
    scene = pm.PrototypeMap(encoder, DIM)
    parts = range(first, last, _PART)
    with progress_bar() as progress:
        for begin in tracked(parts, progress, "make the map", len(parts)):
            ids = np.arange(begin, min(begin + _PART, last))
            scene.add_codes(ids, synthetic.prototypes(len(ids), begin))
            scene.set_positions(ids, positions(begin, len(ids)))
    return scene


def make_map(path: Path, synthetic: SyntheticLandmarks, encoder: pm.Encoder, count: int) -> None:
    """Seal a map of so many synthetic landmarks."""
    scene = learning_map(synthetic, encoder, 0, count)
    scene.build_index(threads=THREADS, in_place=True)
    scene.seal(path, position_bits=16)


def frame(
    scene: pm.PrototypeMap | pm.SealedMap | pm.ShardedMap,
    synthetic: SyntheticLandmarks,
    place: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Keypoints and descriptors of a frame that was taken at a place."""
    seen = np.sort(place * PLACE + rng.choice(PLACE, SEEN, replace=False))
    elsewhere = int(rng.integers(0, len(scene) // PLACE))
    others = elsewhere * PLACE + rng.choice(PLACE, KEYPOINTS - SEEN, replace=False)
    points = scene.positions(seen) - center(np.int64(place))
    pixels = CAMERA.project(points) + rng.normal(0, 0.5, (SEEN, 2))
    clutter = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (KEYPOINTS - SEEN, 2))
    landmarks = np.concatenate([seen, others])
    return np.concatenate([pixels, clutter]), synthetic.queries(landmarks)


def memory() -> NDArray[np.float64]:
    """Megabytes (2,) that are private and that are resident."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return np.array([int(lines[key].split()[0]) * 1024 / 1e6 for key in ("RssAnon", "VmRSS")])


def main() -> None:
    """Prints the table of docs/results/large-maps.md."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("map", type=Path)
    parser.add_argument("tracks", type=Path, nargs="+", help="of one descriptor")
    parser.add_argument("--landmarks", type=int, default=10_000_000)
    parser.add_argument("--frames", type=int, default=1000)
    args = parser.parse_args()
    real = RealLandmarks.load(args.tracks)
    encoder = pm.Encoder.load(real.descriptor)
    synthetic = SyntheticLandmarks(real, encoder, DIM, observations=2, threads=THREADS)
    if not args.map.exists():
        make_map(args.map, synthetic, encoder, args.landmarks)
    rng = np.random.default_rng(2)
    scene = pm.open(args.map)
    places = rng.integers(0, len(scene) // PLACE, args.frames)
    frames = [frame(scene, synthetic, int(place), rng) for place in places]
    del scene
    before = memory()
    begin = time.perf_counter()
    localizer = Localizer(args.map, recall=RECALL, threads=THREADS)
    opened = time.perf_counter() - begin
    rows = [["opened", f"{1000 * opened:.1f} ms", "", *_growth(before)]]
    seconds: list[float] = []
    found = 0
    for i, (place, (keypoints, descriptors)) in enumerate(zip(places, frames, strict=True), 1):
        pose = localizer.localize_features(keypoints, descriptors, CAMERA)
        seconds.append(pose.seconds["total"])
        if pose.cam_from_world is not None:
            at = camera_centers(pose.cam_from_world[None])[0]
            found += bool(np.linalg.norm(at - center(place)) < 0.1)
        if i in (1, 10, 100, args.frames):
            median = f"{1000 * float(np.median(seconds)):.1f} ms"
            rows.append([f"frame {i}", median, f"{found} of {i}", *_growth(before)])
    size = args.map.stat().st_size
    print(f"{len(localizer.scene):,} landmarks, {size / 1e6:,.0f} MB, recall {RECALL}")
    heads = ["after", "median so far", "poses within 0.1", "private", "resident"]
    print(ReportTable(heads, rows).markdown())


def _growth(before: NDArray[np.float64]) -> list[str]:
    return [f"{megabytes:.1f} MB" for megabytes in memory() - before]


if __name__ == "__main__":
    main()
