"""The demo: from observations to poses, on the bundled sample."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import protomark as pm
from protomark import sample
from protomark.baselines.method import Method
from protomark.evaluation.frames import (
    QueryFrame,
    localize_frame,
    select_matches,
)
from protomark.evaluation.methods import (
    APPEARANCE_BITS,
    PrototypeMethod,
    choose_methods,
    method_choices,
)
from protomark.evaluation.protocol import SupportQuerySplit, split
from protomark.evaluation.results import MethodSummary, SequenceResult, precision_curves
from protomark.evaluation.run import EvaluationOptions, evaluate
from protomark.maps.build import tracks_for
from protomark.plot import ScenePicture, draw_curves, draw_scene, new_figure, save_figure
from protomark.progress import Progress, silent
from protomark.report import percent
from protomark.tracks.file import Tracks

PICTURE, LEARNING_MAP, SEALED_MAP = "protomark_demo.png", "toy.pmk", "toy.sealed.pmk"
BASELINES = ("unaggregated", "random", "majority", "medoid", "mean", "pca-16", "pca-32", "pca-64")
OURS = (
    *("protomark-16", "protomark-32", "protomark-64"),
    *("sealed-9", "sealed-17", "sealed-33", "sealed-65"),
)
# Metadata of the picture, by which a later run recognises its own files.
_MADE_BY = "protomark demo"
# Bytes per landmark in the sealed map.
_SIZE = 33


@dataclass(frozen=True)
class DemoResult:
    """The maps of the demo, and its comparison."""

    comparison: SequenceResult  # all methods on one split
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
    """Build, save and seal a map of the sample, compare it with other ways, localize and draw."""
    began = time.perf_counter()
    tracks = Tracks.load(tracks_path or sample.path())
    loaded = pm.Encoder.load(encoder or tracks.descriptor)
    tracks = tracks_for(loaded, tracks)
    _check_output(output)
    output.mkdir(parents=True, exist_ok=True)
    part = split(tracks, seed=0)
    # The maps replace older ones only with the picture, by which a later run recognises them.
    with tempfile.TemporaryDirectory(dir=output, prefix=".protomark-") as folder:
        sealed, name = _write_maps(tracks, part, loaded, Path(folder))
        method = PrototypeMethod(sealed)
        choices = method_choices([loaded])
        ours = [choice.name for choice in choices if choice.name in OURS]
        chosen = [
            replace(choice, build=lambda _: method) if choice.name == name else choice
            for choice in choose_methods(choices, [*BASELINES, *ours, name])
        ]
        options = EvaluationOptions(seeds=[0], pose_frames=len(part.query_keyframes))
        sequence = str(tracks.info.get("sequence", "toy"))
        comparison = evaluate(tracks, sequence, chosen, options, progress)
        _draw(comparison.rows(), name, _scene(method, tracks, part), output / PICTURE)
        for file in (LEARNING_MAP, SEALED_MAP):
            (Path(folder) / file).replace(output / file)
    return DemoResult(
        comparison,
        shown=name,
        folder=str(output),
        files={f: (output / f).stat().st_size for f in (LEARNING_MAP, SEALED_MAP, PICTURE)},
        encoder_bytes=dict(pm.file_sections(output / SEALED_MAP))["encoder"],
        seconds=time.perf_counter() - began,
    )


def _scene(method: Method, tracks: Tracks, part: SupportQuerySplit) -> ScenePicture:
    """Localizes all query frames, for the picture."""
    located, matched = [], []
    for keyframe in part.query_keyframes:
        frame = QueryFrame.of(tracks, int(keyframe))
        matches = select_matches(*method.match(frame.descriptors))
        positions = tracks.positions_of(matches.landmarks)
        located.append(localize_frame(frame, matches, positions))
        matched.append(positions[located[-1].inliers])
    landmarks = np.unique(tracks.landmark_of_keypoint[part.support_rows])
    return ScenePicture(
        landmarks=tracks.positions_of(landmarks),
        matched=np.concatenate(matched),
        support=tracks.cam_from_world[part.support_keyframes],
        true=tracks.cam_from_world[part.query_keyframes],
        estimated=[one.cam_from_world for one in located],
    )


def _write_maps(
    tracks: Tracks, part: SupportQuerySplit, encoder: pm.Encoder, output: Path
) -> tuple[pm.PrototypeMap | pm.SealedMap, str]:
    """Build, save and seal the map of the support; returns the sealed map and its method's name.

    An encoder without codebooks gives a map of one int8 prototype per landmark.
    """
    compact = bool(encoder.codebooks)
    scene = pm.PrototypeMap(encoder, appearance_bits=APPEARANCE_BITS if compact else 0)
    observed = tracks.landmark_of_keypoint[part.support_rows], tracks.descriptors[part.support_rows]
    scene.add(*observed)
    scene.set_positions(scene.ids, tracks.positions_of(scene.ids))
    scene.save(output / LEARNING_MAP)
    sealed = scene.seal(
        output / SEALED_MAP, *observed, bytes_per_landmark=_SIZE if compact else None
    )
    return sealed, f"sealed-{_SIZE}" if compact else f"protomark-{encoder.dim}"


def _draw(rows: Sequence[MethodSummary], name: str, scene: ScenePicture, path: Path) -> None:
    shown = next(row for row in rows if row.name == name)
    figure = new_figure(13, 6.2, w_pad=0.12, h_pad=0.08, wspace=0.04)
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.2])
    draw_scene(
        left,
        scene,
        f"From above: {percent(shown.pose_recall)} of {len(scene.estimated)} queries found, "
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
