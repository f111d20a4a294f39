"""Measures how many poses a sealed map still gives when it keeps only some of its landmarks.

python benchmarks/scripts/pose_recall_by_size.py TRACKS... --figure docs/results/pose-recall.svg

Queries are never next to the map's frames: `half` localizes the later half of a sequence in a map
of its earlier half, `tenth` every tenth frame in a map that lacks it and its two neighbours. A pose
is found if it is off by at most 1 % of the median scene depth and 2 degrees. Bytes are those of the
sealed file, 16-bit positions included, without the encoder. Landmark positions come from the tracks
file, which triangulated them from all keyframes.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.cli.terminal import progress_bar
from protomark.evaluation.frames import DEGREES, DEPTH_SHARE, QueryFrame, scene_depth
from protomark.geometry.pose import pose_error
from protomark.maps.selection import Views, select_landmarks
from protomark.progress import tracked
from protomark.tracks.file import Tracks
from protomark_bench.plot import (
    AMBER,
    BLUE,
    MUTED,
    TEAL,
    VIOLET,
    Panel,
    Series,
    draw_lines,
    save_svg,
)
from protomark_bench.report import ReportTable

SHARES = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
MIN_OBSERVATIONS = 2


@dataclass(frozen=True)
class Kind:
    """A way to make a smaller map: which landmarks stay, and what each of them keeps."""

    selection: str
    dim: int = 48
    appearance_bits: int = 5
    bytes_per_landmark: float = 33.0


KINDS = {
    "coverage": (Kind("coverage"), TEAL),
    "random": (Kind("random"), MUTED),
    "most seen": (Kind("most seen"), AMBER),
    "coverage, one prototype": (Kind("coverage", 64, 0), VIOLET),
    "coverage, 17 bytes": (Kind("coverage", 24, 5, 17.0), BLUE),
}


def splits(keyframes: int) -> Iterator[tuple[str, NDArray[np.bool_], NDArray[np.intp]]]:
    """Name, which keyframes are mapped, and which are localized."""
    frames = np.arange(keyframes)
    earlier = frames < keyframes // 2
    yield "half", earlier, np.flatnonzero(~earlier)
    queries = frames[5::10]
    yield "tenth", np.abs(frames[:, None] - queries).min(axis=1) > 1, queries


def recalls(
    tracks: Tracks, mapped: NDArray[np.bool_], frames: list[QueryFrame]
) -> Iterator[tuple[str, float, float]]:
    """Kind of map, megabytes and share of the frames that are found, for each of `SHARES`."""
    part = tracks.where(mapped[tracks.keyframe_of_keypoint])
    rows = part.observations
    ids, inverse, counts = np.unique(
        part.landmark_of_keypoint[rows], return_inverse=True, return_counts=True
    )
    rows = rows[counts[inverse] >= MIN_OBSERVATIONS]
    ids, counts = ids[counts >= MIN_OBSERVATIONS], counts[counts >= MIN_OBSERVATIONS]
    encoder = pm.Encoder.load(tracks.descriptor)
    shuffled = np.random.default_rng(0).permutation(len(ids))
    orders = {
        "coverage": select_landmarks(ids, Views.of_tracks(part), len(ids)),
        "random": ids[shuffled],
        "most seen": ids[shuffled[np.argsort(-counts[shuffled], kind="stable")]],
    }
    depth = scene_depth(tracks)
    with tempfile.TemporaryDirectory() as folder:
        encoder.save(Path(folder) / "encoder.pme")
        encoder_bytes = (Path(folder) / "encoder.pme").stat().st_size
        for name, (kind, _) in KINDS.items():
            scene = pm.PrototypeMap(encoder, kind.dim, kind.appearance_bits)
            scene.add(part.landmark_of_keypoint[rows], part.descriptors[rows])
            scene.set_positions(ids, part.positions_of(ids))
            for share in SHARES:
                kept = orders[kind.selection][: max(4, round(share * len(ids)))]
                path = Path(folder) / f"{name}.{share}.pmk"
                localizer = pm.Localizer(
                    scene.part(kept).seal(
                        path, bytes_per_landmark=kind.bytes_per_landmark, position_bits=16
                    )
                )
                found = sum(is_found(localizer, frame, depth) for frame in frames)
                megabytes = (path.stat().st_size - encoder_bytes) / 1e6
                yield name, megabytes, found / len(frames)


def is_found(localizer: pm.Localizer, frame: QueryFrame, depth: float) -> bool:
    """Whether the pose of a frame is found, and near the true one."""
    pose = localizer.localize_features(frame.keypoints, frame.descriptors, frame.camera)
    if pose.cam_from_world is None:
        return False
    distance, angle = pose_error(pose.cam_from_world, frame.cam_from_world)
    return distance <= DEPTH_SHARE * depth and angle <= DEGREES


def main() -> None:
    """Prints the mean over the sequences; draws each of them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tracks", type=Path, nargs="+")
    parser.add_argument("--queries", type=int, default=40, help="most per split; default: 40")
    parser.add_argument("--figure", type=Path, required=True, help="SVG to write")
    args = parser.parse_args()
    panels: list[Panel] = []
    found: dict[tuple[str, str], list[list[float]]] = {}
    with progress_bar() as progress:
        for path in tracked(args.tracks, progress, "localize", len(args.tracks)):
            tracks = Tracks.load(path)
            for split, mapped, queries in splits(len(tracks.keyframe_names)):
                spread = np.linspace(0, len(queries) - 1, args.queries).astype(int)
                frames = [QueryFrame.of(tracks, int(i)) for i in queries[np.unique(spread)]]
                curves: dict[str, list[tuple[float, float]]] = {name: [] for name in KINDS}
                for name, *point in recalls(tracks, mapped, frames):
                    curves[name].append((point[0], point[1]))
                for name, points in curves.items():
                    found.setdefault((split, name), []).append([recall for _, recall in points])
                series = []
                for name, (_, color) in KINDS.items():
                    megabytes, recall = zip(*curves[name], strict=True)
                    series.append(Series(name, megabytes, recall, color))
                title = f"{path.name.split('.')[0]}, {split}: {len(frames)} frames"
                panels.append(
                    Panel(title, "megabytes", "poses found", series, log="x", bottom=0, top=1.02)
                )
    heads = ["queries", "map", *(f"{100 * share:g} %" for share in SHARES)]
    rows = [
        [split, name, *(f"{recall:.3f}" for recall in np.mean(of_sequences, axis=0))]
        for (split, name), of_sequences in sorted(found.items())
    ]
    print(ReportTable(heads, rows, words=2).markdown())
    save_svg(draw_lines(panels, columns=2, height=3.0), args.figure, "pose_recall_by_size.py")


if __name__ == "__main__":
    main()
