"""The demo: from observations to poses, on the sample that ships."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark import sample
from protomark.baselines.method import Method
from protomark.baselines.support import Support
from protomark.evaluation.frames import (
    LocalizedFrame,
    QueryFrame,
    localize_frame,
    scene_depth,
    select_matches,
)
from protomark.evaluation.methods import (
    APPEARANCE_BITS,
    APPEARANCE_DIMS,
    PrototypeMethod,
    choose_methods,
    method_choices,
)
from protomark.evaluation.protocol import SupportQuerySplit, split
from protomark.evaluation.results import MethodSummary, precision_curves
from protomark.maps.build import tracks_for
from protomark.plot import ScenePicture, draw_curves, draw_scene, new_figure, save_figure
from protomark.progress import Progress, silent
from protomark.threads import one_blas_thread
from protomark.tracks.file import Tracks

PICTURE, LEARNING_MAP, SEALED_MAP = "protomark_demo.png", "toy.pmk", "toy.sealed.pmk"
BASELINES = ("unaggregated", "random", "majority", "medoid", "mean", "pca-16", "pca-32", "pca-64")
OURS = (
    *("protomark-16", "protomark-32", "protomark-64"),
    *("protomark-32x4", "protomark-64x4"),
    *("appearances-17", "appearances-33", "appearances-65"),
)
# Written into the picture, so that a later run recognises its own files.
_MADE_BY = "protomark demo"
# Bytes of a position in a sealed map.
_POSITION_BYTES = 12
# Bytes per landmark of the sealed map.
_SIZE = 33


@dataclass(frozen=True)
class DemoRow:
    """Results of one method.

    Attributes:
        bytes_per_landmark: all that matching needs, the count included, the position not.
        map_bytes: that of all landmarks, with positions.
        precision: share of query descriptors whose nearest landmark is their own.
        found: query keyframes whose pose is within 1 % of the median scene depth and 2 degrees.
        frames: query keyframes.
        median_error: median distance from the true camera centre, as a share of that depth.
        ms_per_frame: matching and RANSAC of a whole frame on one thread.
    """

    name: str
    label: str
    family: str
    bytes_per_landmark: float
    map_bytes: int
    precision: float
    found: int
    frames: int
    median_error: float
    ms_per_frame: float


@dataclass(frozen=True)
class DemoResult:
    """What the demo built and compared.

    Attributes:
        sequence: name of the tracks' sequence.
        descriptor: name of the descriptor.
        bits: its length in bits.
        support_keyframes: keyframes that built the map.
        landmarks: landmarks of the map.
        observations: observations of the map.
        rows: one per method.
        shown: name of the row that the sealed map and the picture are of.
        folder: where the files were written.
        files: sizes in bytes by name.
        encoder_bytes: how many of the sealed map's bytes are its encoder.
        seconds: from start to end.
    """

    sequence: str
    descriptor: str
    bits: int
    support_keyframes: int
    landmarks: int
    observations: int
    rows: list[DemoRow]
    shown: str
    folder: str
    files: dict[str, int]
    encoder_bytes: int
    seconds: float


def run_demo(
    output: Path,
    *,
    tracks_path: Path | None = None,
    encoder: str | None = None,
    progress: Progress = silent,
) -> DemoResult:
    """Build, save and seal a map of the sample, localize query keyframes, compare, draw.

    Args:
        output: folder for the two maps and the picture; it is made if it does not exist.
        tracks_path: other tracks than the sample's.
        encoder: name or path of the encoder; by default the descriptor's own.
        progress: called with each method.

    Raises:
        FileExistsError: a file of the same name that the demo did not write is in the way.
    """
    began = time.perf_counter()
    tracks = Tracks.load(tracks_path or sample.path())
    loaded = pm.Encoder.load(encoder or tracks.descriptor)
    tracks = tracks_for(loaded, tracks)
    _check_output(output)
    output.mkdir(parents=True, exist_ok=True)
    # The maps take their places together with the picture, by which a later run recognises them.
    with tempfile.TemporaryDirectory(dir=output, prefix=".protomark-") as folder:
        demo = _Demo(tracks, loaded, Path(folder))
        rows, scene = demo.compare(progress)
        shown = next(row for row in rows if row.name == demo.shown)
        _draw(rows, shown, scene, output / PICTURE)
        for name in (LEARNING_MAP, SEALED_MAP):
            (Path(folder) / name).replace(output / name)
    files = {name: (output / name).stat().st_size for name in (LEARNING_MAP, SEALED_MAP, PICTURE)}
    return DemoResult(
        sequence=str(tracks.info.get("sequence", "toy")),
        descriptor=tracks.descriptor,
        bits=tracks.bits,
        support_keyframes=len(demo.part.support_keyframes),
        landmarks=len(demo.support.ids),
        observations=len(demo.support.landmarks),
        rows=rows,
        shown=demo.shown,
        folder=str(output),
        files=files,
        encoder_bytes=dict(pm.file_sections(output / SEALED_MAP))["encoder"],
        seconds=time.perf_counter() - began,
    )


class _Demo:
    """The sample split into support and queries, and its map, sealed and opened again.

    Attributes:
        shown: name of the method that the sealed map is.
    """

    def __init__(self, tracks: Tracks, encoder: pm.Encoder, maps: Path) -> None:
        self.tracks, self.encoder = tracks, encoder
        self.part = split(tracks, seed=0)
        rows = self.part.support_rows
        self.support = Support(tracks.landmark_of_keypoint[rows], tracks.descriptors[rows])
        self.sealed, self.shown = _write_maps(tracks, self.part, encoder, maps)

    def compare(self, progress: Progress) -> tuple[list[DemoRow], ScenePicture]:
        """Each method's row, and the picture of the map that is shown."""
        tracks, part = self.tracks, self.part
        frames = [QueryFrame.of(tracks, int(keyframe)) for keyframe in part.query_keyframes]
        choices = method_choices([self.encoder])
        ours = [choice.name for choice in choices if choice.name in OURS]
        chosen = choose_methods(choices, [*BASELINES, *ours, self.shown])
        rows, depth = [], scene_depth(tracks)
        located: list[LocalizedFrame] = []
        matched: list[NDArray[np.float64]] = []
        with one_blas_thread():
            for done, choice in enumerate(chosen):
                progress(f"compare, {choice.label}", done, len(chosen))
                shown = choice.name == self.shown
                method = PrototypeMethod(self.sealed) if shown else choice.build(self.support)
                answers, _ = method.match(tracks.descriptors[part.query_rows])
                right = answers[:, 0] == tracks.landmark_of_keypoint[part.query_rows]
                start = time.perf_counter()
                results = [_localize(method, frame, tracks) for frame in frames]
                seconds = time.perf_counter() - start
                if shown:
                    located = [one for one, _ in results]
                    matched = [positions[one.inliers] for one, positions in results]
                size = method.bytes_per_landmark
                errors = [one.position_error for one, _ in results]
                rows.append(
                    DemoRow(
                        name=choice.name,
                        label=choice.label,
                        family=choice.family,
                        bytes_per_landmark=size,
                        map_bytes=round(len(self.support.ids) * (size + _POSITION_BYTES)),
                        precision=float(right.mean()),
                        found=sum(one.found(depth) for one, _ in results),
                        frames=len(frames),
                        median_error=float(np.median(errors)) / depth,
                        ms_per_frame=1000 * seconds / len(frames),
                    )
                )
        scene = ScenePicture(
            landmarks=tracks.positions_of(self.support.ids),
            matched=np.concatenate(matched),
            support=tracks.cam_from_world[part.support_keyframes],
            true=tracks.cam_from_world[part.query_keyframes],
            estimated=[one.cam_from_world for one in located],
        )
        return rows, scene


def _localize(
    method: Method, frame: QueryFrame, tracks: Tracks
) -> tuple[LocalizedFrame, NDArray[np.float64]]:
    """The pose of a frame by a method, and the positions of the selected matches."""
    matches = select_matches(*method.match(frame.descriptors))
    positions = tracks.positions_of(matches.landmarks)
    return localize_frame(frame, matches, positions), positions


def _write_maps(
    tracks: Tracks, part: SupportQuerySplit, encoder: pm.Encoder, output: Path
) -> tuple[pm.PrototypeMap | pm.SealedMap, str]:
    """Build the map of the support, save and seal it, and open the sealed file again.

    If the encoder has the dimensions for it the map keeps several appearances, in 33 bytes per
    landmark, else one int8 prototype. Also returns the name of the method that this is.
    """
    dim = APPEARANCE_DIMS[_SIZE]
    several = dim in encoder.dims
    if several:
        scene = pm.PrototypeMap(encoder, dim=dim, appearance_bits=APPEARANCE_BITS)
    else:
        scene = pm.PrototypeMap(encoder)
    scene.add(tracks.landmark_of_keypoint[part.support_rows], tracks.descriptors[part.support_rows])
    scene.set_positions(scene.ids, tracks.positions_of(scene.ids))
    scene.save(output / LEARNING_MAP)
    sealed = scene.seal(output / SEALED_MAP, bytes_per_landmark=_SIZE if several else None)
    return sealed, f"appearances-{_SIZE}" if several else f"protomark-{encoder.dim}"


def _draw(rows: list[DemoRow], shown: DemoRow, scene: ScenePicture, path: Path) -> None:
    figure = new_figure(13, 6.2, w_pad=0.12, h_pad=0.08, wspace=0.04)
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.2])
    draw_scene(
        left,
        scene,
        f"From above: {shown.found} of {shown.frames} queries found, "
        f"{shown.bytes_per_landmark:.0f} bytes per landmark",
    )
    points = [
        MethodSummary(row.name, row.label, row.family, row.bytes_per_landmark, row.precision)
        for row in rows
    ]
    title = "Is the nearest landmark the right one?"
    draw_curves(right, precision_curves(points), "bytes per landmark (log)", "precision", title)
    save_figure(figure, path, made_by=_MADE_BY)


def _check_output(output: Path) -> None:
    """Raise before any work if a file that no demo wrote would be overwritten."""
    if output.exists() and not output.is_dir():
        raise FileExistsError(f"{output} is not a folder: name another one with --output")
    picture = output / PICTURE
    if picture.is_file():
        with picture.open("rb") as file:
            if _MADE_BY.encode() in file.read(4096):
                return
    # A map does not say who made it, so without the picture it counts as somebody else's.
    for path in (picture, output / LEARNING_MAP, output / SEALED_MAP):
        if path.exists():
            raise FileExistsError(
                f"{path} was not written by `protomark demo` and would be replaced: "
                "name another folder with --output"
            )
