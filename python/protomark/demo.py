"""`protomark demo`: the whole way from observations to poses, on the map that ships."""

from __future__ import annotations

import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark import sample
from protomark.build import check_descriptor
from protomark.console import console, progress_bar
from protomark.evaluation import pose
from protomark.evaluation.methods import LOOK_BITS, LOOKS_DIMS, choices, choose
from protomark.evaluation.methods.method import Method
from protomark.evaluation.methods.prototypes import PrototypeMethod, prototypes_in
from protomark.evaluation.plot import draw_precision, save_figure
from protomark.evaluation.protocol import Split, split
from protomark.evaluation.results import Summary
from protomark.evaluation.run import positions_of
from protomark.evaluation.scene_plot import ScenePicture, draw_scene
from protomark.evaluation.support import Support
from protomark.evaluation.threads import one_blas_thread
from protomark.tracks.file import Tracks

PICTURE, OPEN_MAP, SEALED_MAP = "protomark_demo.png", "toy.pmk", "toy.sealed.pmk"
BASELINES = ("unaggregated", "random", "majority", "medoid", "mean", "pca-16", "pca-32", "pca-64")
OURS = (
    *("protomark-16", "protomark-32", "protomark-64"),
    *("protomark-32x4", "protomark-64x4"),
    *("looks-17", "looks-33", "looks-65"),
)
# Written into the picture, so that a later run knows its own.
_MADE_BY = "protomark demo"
# A position as a sealed map keeps it.
_POSITION_BYTES = 12
# Bytes a landmark of the map that is sealed.
_SIZE = 33


@dataclass(frozen=True)
class DemoRow:
    """Figures of one method.

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
    """All rows, and the files that were written with their sizes in bytes.

    Attributes:
        shown: name of the row that the sealed map and the picture are of.
        encoder_bytes: how many of the sealed map's bytes are its encoder.
        seconds: from start to end.
    """

    rows: list[DemoRow]
    shown: str
    folder: str
    files: dict[str, int]
    encoder_bytes: int
    seconds: float

    def as_dict(self) -> dict[str, object]:
        """As JSON values."""
        return asdict(self)


def run_demo(
    output: Path,
    *,
    tracks_path: Path | None = None,
    encoder: str | None = None,
) -> DemoResult:
    """Build, save and seal a map of the sample, localize query keyframes, compare, draw.

    Args:
        output: folder for the two maps and the picture; it is made if it is not there.
        tracks_path: other tracks than the sample's.
        encoder: name or path of the encoder; by default the descriptor's own.

    Raises:
        FileExistsError: a file of the same name, but not of the demo's making, is in the way.
    """
    began = time.perf_counter()
    tracks = Tracks.load(tracks_path or sample.path())
    coder = pm.Encoder.load(encoder or tracks.descriptor)
    check_descriptor(tracks, coder)
    _check_output(output)
    output.mkdir(parents=True, exist_ok=True)
    # The maps come to their places with the picture, by which a later run knows them as its own.
    with tempfile.TemporaryDirectory(dir=output, prefix=".protomark-") as maps:
        rows, shown, files = _compare(tracks, coder, Path(maps), output)
    encoder_bytes = dict(pm.file_sections(output / SEALED_MAP))["encoder"]
    seconds = time.perf_counter() - began
    return DemoResult(rows, shown, str(output), files, encoder_bytes, seconds)


def _compare(
    tracks: Tracks, coder: pm.Encoder, maps: Path, output: Path
) -> tuple[list[DemoRow], str, dict[str, int]]:
    """Rows, the name of the one that is shown, and sizes of the files, which are in `output` then.

    `maps` is a folder of the same file system for the maps until then.
    """
    part = split(tracks, seed=0)
    support = Support(
        tracks.landmark_of_keypoint[part.support_rows], tracks.descriptors[part.support_rows]
    )
    frames = [pose.Frame.of(tracks, int(keyframe)) for keyframe in part.query_keyframes]
    sealed, shown, files = _write_maps(tracks, part, coder, maps)

    console.print(
        f"[bold]{tracks.info.get('sequence', 'toy')}[/]: {len(part.support_keyframes)} keyframes "
        f"build a map of {len(support.ids):,} landmarks from {len(support.landmarks):,} "
        f"observations ({tracks.descriptor.upper()}, {tracks.bits} bits), {len(frames)} are "
        "localized in it.",
        highlight=False,
    )
    listed = choices([coder])
    ours_here = [name for name in OURS if name in {choice.name for choice in listed}]
    compared = choose(listed, [*BASELINES, *ours_here, shown])
    rows, depth = [], pose.scene_depth(tracks)
    ours: list[pose.Localization] = []
    matched: list[NDArray[np.float64]] = []
    with progress_bar() as progress, one_blas_thread():
        task = progress.add_task("", total=len(compared))
        for choice in compared:
            progress.update(task, description=choice.label)
            is_sealed = choice.name == shown
            method = PrototypeMethod(sealed) if is_sealed else choice.build(support)
            answers, _ = method.match(tracks.descriptors[part.query_rows])
            right = answers[:, 0] == tracks.landmark_of_keypoint[part.query_rows]
            located = []
            start = time.perf_counter()
            for frame in frames:
                localization, positions = _localize(method, frame, tracks)
                located.append(localization)
                if is_sealed:
                    ours.append(localization)
                    matched.append(positions[localization.inliers])
            seconds = time.perf_counter() - start
            rows.append(
                DemoRow(
                    name=choice.name,
                    label=choice.label,
                    family=choice.family,
                    bytes_per_landmark=method.bytes_per_landmark,
                    map_bytes=round(
                        len(support.ids) * (method.bytes_per_landmark + _POSITION_BYTES)
                    ),
                    precision=float(right.mean()),
                    found=sum(one.found(depth) for one in located),
                    frames=len(frames),
                    median_error=float(np.median([one.position_error for one in located])) / depth,
                    ms_per_frame=1000 * seconds / len(frames),
                )
            )
            progress.advance(task)
        progress.update(task, description="Picture")
        scene = ScenePicture(
            landmarks=positions_of(tracks, support.ids),
            matched=np.concatenate(matched),
            support=tracks.cam_from_world[part.support_keyframes],
            true=tracks.cam_from_world[part.query_keyframes],
            estimated=[one.cam_from_world for one in ours],
        )
        _draw(rows, next(r for r in rows if r.name == shown), scene, output / PICTURE)
    for name in (OPEN_MAP, SEALED_MAP):
        (maps / name).replace(output / name)
    files[PICTURE] = (output / PICTURE).stat().st_size
    return rows, shown, files


def show(result: DemoResult) -> None:
    """Print the table, the files, and what it all means."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(header_style="", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.show_edge = False
    for head in (
        "method",
        "bytes per\nlandmark",
        "whole\nmap",
        "precision",
        "poses\nfound",
        "median\nerror",
        "ms per\nframe",
    ):
        table.add_column(head, justify="left" if head == "method" else "right", no_wrap=True)
    for row in result.rows:
        table.add_row(
            row.label,
            f"{row.bytes_per_landmark:,.0f}",
            size(row.map_bytes),
            f"{row.precision:.3f}",
            f"{row.found} of {row.frames}",
            f"{100 * row.median_error:.2f}%",
            f"{row.ms_per_frame:.0f}",
            style="bold green" if row.family.startswith("protomark") else "",
        )
    console.print(table)
    console.print(
        "Whole map: landmarks with position (12 bytes), without what exists once, such as the "
        "encoder. Median error: of the camera position, as a share of the median scene depth; "
        "found: within 1 % of it and 2 degrees. ms: matching and RANSAC on one thread.",
        style="dim",
        highlight=False,
    )
    folder = Path(result.folder)
    written = ", ".join(f"{folder / name} ({size(count)})" for name, count in result.files.items())
    console.print(
        f"Wrote {written} in {result.seconds:.0f} s.", markup=False, highlight=False, soft_wrap=True
    )

    rows = {row.name: row for row in result.rows}
    whole = rows["unaggregated"]
    ours = rows[result.shown]
    console.print(
        f"[bold]What it means:[/] {ours.bytes_per_landmark:.0f} bytes a landmark in place of "
        f"{whole.bytes_per_landmark:.0f} keep {100 * ours.precision / whole.precision:.0f} % of "
        f"the precision; in the sealed map the encoder adds {size(result.encoder_bytes)}, however "
        "large the map gets.",
        highlight=False,
        soft_wrap=True,
    )
    console.print(
        "[bold]What next:[/] `protomark tracks --help` makes such observations from your own "
        "images and poses, `protomark build` a map, `protomark evaluate` this comparison with "
        "every baseline.",
        highlight=False,
        soft_wrap=True,
    )


def size(count: float) -> str:
    """Bytes as KB or MB (powers of ten)."""
    return f"{count / 1e6:.2f} MB" if count >= 1e6 else f"{count / 1e3:.0f} KB"


def _localize(
    method: Method, frame: pose.Frame, tracks: Tracks
) -> tuple[pose.Localization, NDArray[np.float64]]:
    """The pose of a frame by a method, and the positions of the accepted matches."""
    landmarks, distances = method.match(frame.descriptors)
    matches = pose.accept(landmarks, distances)
    positions = positions_of(tracks, matches.landmarks)
    return pose.localize(frame, matches, positions), positions


def _write_maps(
    tracks: Tracks, part: Split, encoder: pm.Encoder, output: Path
) -> tuple[pm.PrototypeMap | pm.SealedMap, str, dict[str, int]]:
    """Build the map of the support, save and seal it, and open the sealed file again.

    Where the encoder has the dimensions for it the map keeps several looks, in 33 bytes a landmark,
    else one int8 prototype. Also returns the name of the method that this is.
    """
    dim = LOOKS_DIMS[_SIZE]
    several = dim in encoder.dims
    if several:
        scene = pm.PrototypeMap(encoder, dim=dim, look_bits=LOOK_BITS)
    else:
        scene = pm.PrototypeMap(encoder)
    scene.add(tracks.landmark_of_keypoint[part.support_rows], tracks.descriptors[part.support_rows])
    scene.set_positions(scene.ids, positions_of(tracks, scene.ids))
    scene.save(output / OPEN_MAP)
    if several:
        scene.seal(output / SEALED_MAP, bits=4, prototypes=prototypes_in(_SIZE, dim))
    else:
        scene.seal(output / SEALED_MAP)
    shown = f"looks-{_SIZE}" if several else f"protomark-{encoder.dim}"
    sizes = {name: (output / name).stat().st_size for name in (OPEN_MAP, SEALED_MAP)}
    return pm.open(output / SEALED_MAP), shown, sizes


def _draw(rows: list[DemoRow], ours: DemoRow, scene: ScenePicture, path: Path) -> None:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.08, wspace=0.04)
    figure = Figure(figsize=(13, 6.2), layout=layout)
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.2])
    draw_scene(
        left,
        scene,
        f"From above: {ours.found} of {ours.frames} queries found, "
        f"{ours.bytes_per_landmark:.0f} bytes a landmark",
    )
    draw_precision(right, [_summary(row) for row in rows], "Is the nearest landmark the right one?")
    save_figure(figure, path, made_by=_MADE_BY)


def _summary(row: DemoRow) -> Summary:
    return Summary(
        name=row.name,
        label=row.label,
        family=row.family,
        bytes_per_landmark=row.bytes_per_landmark,
        precision=row.precision,
        spread=None,
        ratio=None,
        pose_recall=None,
        right_share=None,
        search_ms=row.ms_per_frame,
    )


def _check_output(output: Path) -> None:
    """Refuse to write over what an earlier demo did not write."""
    if output.exists() and not output.is_dir():
        raise FileExistsError(f"{output} is not a folder: name another one with --output")
    picture = output / PICTURE
    if _is_own_picture(picture):
        return
    # A map does not say who made it: without the picture it is somebody else's.
    for path in (picture, output / OPEN_MAP, output / SEALED_MAP):
        if path.exists():
            raise FileExistsError(
                f"{path} was not written by `protomark demo` and would be replaced: "
                "name another folder with --output"
            )


def _is_own_picture(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return _MADE_BY.encode() in file.read(4096)
