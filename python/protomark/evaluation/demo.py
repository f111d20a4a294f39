"""The demo: from observations to poses, on the bundled sample."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import protomark as pm
from protomark import sample
from protomark.baselines.method import Method
from protomark.baselines.support import Support
from protomark.evaluation.frames import (
    QueryFrame,
    localize_frame,
    scene_depth,
    select_matches,
)
from protomark.evaluation.methods import (
    APPEARANCE_BITS,
    APPEARANCE_DIMS,
    MethodChoice,
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
# Metadata of the picture, by which a later run recognises its own files.
_MADE_BY = "protomark demo"
# Bytes per position in a sealed map.
_POSITION_BYTES = 12
# Bytes per landmark in the sealed map.
_SIZE = 33


@dataclass
class DemoRow(MethodSummary):
    """Results of one method."""

    map_bytes: int = 0  # bytes of all landmarks with positions
    # Query keyframes whose pose is within 1 % of the median scene depth and 2 degrees.
    found: int = 0
    frames: int = 0  # query keyframes
    # Median distance from the true camera centre, as a share of that depth.
    median_error: float = 0.0
    ms_per_frame: float = 0.0  # milliseconds to match and localize a frame on one thread


@dataclass(frozen=True)
class DemoResult:
    """The maps of the demo, and its comparison."""

    sequence: str
    descriptor: str
    bits: int  # length of the descriptor in bits
    support_keyframes: int  # keyframes that build the map
    landmarks: int  # landmarks of the map
    observations: int  # observations of the map
    rows: list[DemoRow]  # one row per method
    shown: str  # name of the method that the sealed map and the picture show
    folder: str  # folder of the files
    files: dict[str, int]  # sizes in bytes by file name
    encoder_bytes: int  # bytes of the encoder in the sealed map
    seconds: float  # duration of the demo


def run_demo(
    output: Path,  # folder of the two maps and the picture, created if it does not exist
    *,
    tracks_path: Path | None = None,  # tracks to take in place of the sample's
    encoder: str | None = None,  # name or path of the encoder; None: the one for the descriptor
    progress: Progress = silent,
) -> DemoResult:
    """Build, save and seal a map of the sample, localize query keyframes, compare and draw."""
    began = time.perf_counter()
    tracks = Tracks.load(tracks_path or sample.path())
    loaded = pm.Encoder.load(encoder or tracks.descriptor)
    tracks = tracks_for(loaded, tracks)
    _check_output(output)
    output.mkdir(parents=True, exist_ok=True)
    part = split(tracks, seed=0)
    support = Support(
        tracks.landmark_of_keypoint[part.support_rows], tracks.descriptors[part.support_rows]
    )
    # The maps replace older ones only with the picture, by which a later run recognises them.
    with tempfile.TemporaryDirectory(dir=output, prefix=".protomark-") as folder:
        sealed, name = _write_maps(tracks, part, loaded, Path(folder))
        choices = method_choices([loaded])
        ours = [choice.name for choice in choices if choice.name in OURS]
        chosen = choose_methods(choices, [*BASELINES, *ours, name])
        rows, pictures = [], {}
        with one_blas_thread():
            for done, choice in enumerate(chosen):
                progress(f"compare, {choice.label}", done, len(chosen))
                shown = choice.name == name
                method = PrototypeMethod(sealed) if shown else choice.build(support)
                row, pictures[choice.name] = _measure(choice, method, tracks, part, support)
                rows.append(row)
        _draw(rows, name, pictures[name], output / PICTURE)
        for file in (LEARNING_MAP, SEALED_MAP):
            (Path(folder) / file).replace(output / file)
    return DemoResult(
        sequence=str(tracks.info.get("sequence", "toy")),
        descriptor=tracks.descriptor,
        bits=tracks.bits,
        support_keyframes=len(part.support_keyframes),
        landmarks=len(support.ids),
        observations=len(support.landmarks),
        rows=rows,
        shown=name,
        folder=str(output),
        files={f: (output / f).stat().st_size for f in (LEARNING_MAP, SEALED_MAP, PICTURE)},
        encoder_bytes=dict(pm.file_sections(output / SEALED_MAP))["encoder"],
        seconds=time.perf_counter() - began,
    )


def _measure(
    choice: MethodChoice, method: Method, tracks: Tracks, part: SupportQuerySplit, support: Support
) -> tuple[DemoRow, ScenePicture]:
    """The results of a method, and the data of a picture of its localized frames."""
    answers, _ = method.match(tracks.descriptors[part.query_rows])
    right = answers[:, 0] == tracks.landmark_of_keypoint[part.query_rows]
    frames = [QueryFrame.of(tracks, int(keyframe)) for keyframe in part.query_keyframes]
    start = time.perf_counter()
    located, matched = [], []
    for frame in frames:
        matches = select_matches(*method.match(frame.descriptors))
        positions = tracks.positions_of(matches.landmarks)
        located.append(localize_frame(frame, matches, positions))
        matched.append(positions[located[-1].inliers])
    seconds = time.perf_counter() - start
    size, depth = method.bytes_per_landmark, scene_depth(tracks)
    row = DemoRow(
        name=choice.name,
        label=choice.label,
        family=choice.family,
        bytes_per_landmark=size,
        map_bytes=round(len(support.ids) * (size + _POSITION_BYTES)),
        precision=float(right.mean()),
        found=sum(one.found(depth) for one in located),
        frames=len(frames),
        median_error=float(np.median([one.position_error for one in located])) / depth,
        ms_per_frame=1000 * seconds / len(frames),
    )
    picture = ScenePicture(
        landmarks=tracks.positions_of(support.ids),
        matched=np.concatenate(matched),
        support=tracks.cam_from_world[part.support_keyframes],
        true=tracks.cam_from_world[part.query_keyframes],
        estimated=[one.cam_from_world for one in located],
    )
    return row, picture


def _write_maps(
    tracks: Tracks, part: SupportQuerySplit, encoder: pm.Encoder, output: Path
) -> tuple[pm.PrototypeMap | pm.SealedMap, str]:
    """Build, save and seal the map of the support; returns the sealed map and its method's name.

    If the encoder has the dimensions for it, the map keeps several appearances in 33 bytes per
    landmark, otherwise one int8 prototype.
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


def _draw(rows: list[DemoRow], name: str, scene: ScenePicture, path: Path) -> None:
    shown = next(row for row in rows if row.name == name)
    figure = new_figure(13, 6.2, w_pad=0.12, h_pad=0.08, wspace=0.04)
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.2])
    draw_scene(
        left,
        scene,
        f"From above: {shown.found} of {shown.frames} queries found, "
        f"{shown.bytes_per_landmark:.0f} bytes per landmark",
    )
    title = "Is the nearest landmark the right one?"
    draw_curves(right, precision_curves(rows), "bytes per landmark (log)", "precision", title)
    save_figure(figure, path, made_by=_MADE_BY)


def _check_output(output: Path) -> None:
    """Raise before any work if the demo would overwrite a file that no demo wrote."""
    picture = output / PICTURE
    if picture.is_file():
        with picture.open("rb") as file:
            if _MADE_BY.encode() in file.read(4096):
                return
    # A map does not tell who made it, so without the picture it may be somebody else's.
    for path in (picture, output / LEARNING_MAP, output / SEALED_MAP):
        if path.exists():
            raise FileExistsError(
                f"{path} was not written by `protomark demo` and would be replaced: "
                "name another folder with --output"
            )
