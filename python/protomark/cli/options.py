"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.threads import available_threads


def _checked_json(path: Path | None) -> Path | None:
    """The file of --json, which replaces nothing but JSON."""
    if path is not None and path.is_file():
        with path.open("rb") as file:
            if file.read(1) not in (b"", b"{", b"["):
                raise ValueError(f"--json {path} exists and is no JSON: name another file")
    return path


JsonFile = Annotated[
    Path | None,
    typer.Option(
        "--json",
        metavar="FILE",
        callback=_checked_json,
        help="Write the results to this JSON file, too.",
    ),
]
EncoderName = Annotated[
    str | None,
    typer.Option(
        "--encoder",
        metavar="NAME|FILE",
        help="Encoder that ships, or a model file (.pme). By default the one for the descriptor.",
    ),
]
CameraText = Annotated[
    str | None,
    typer.Option(
        "--camera",
        metavar="CAMERA",
        help="COLMAP's cameras.txt, a folder with a COLMAP model, or a camera written out: "
        "PINHOLE:525,525,320,240 or 'PINHOLE 640 480 525 525 320 240'. Without it the camera is "
        "calibrated from EXIF data and matches.",
    ),
]
BagTopic = Annotated[
    str | None,
    typer.Option(
        "--topic",
        help="Topic of a ROS bag's images; by default the only one. The CameraInfo beside it is "
        "the camera, unless another is given.",
    ),
]
MaxKeypoints = Annotated[
    int,
    typer.Option(min=4, help="Limit on keypoints per image: the strongest, spread over the image."),
]
MaxQueryKeypoints = Annotated[
    int | None,
    typer.Option(
        "--max-keypoints",
        min=4,
        help="Limit on keypoints per image; by default as many as an image of the map had, if "
        "the map knows, or 2000.",
    ),
]
Recall = Annotated[
    float | None,
    typer.Option(
        min=0,
        max=1,
        help="Search a map with an index approximately: share of nearest landmarks that are "
        "found, for example 0.98. Without it the search is exact.",
    ),
]
MaxSize = Annotated[
    int,
    typer.Option(
        min=64, help="Images with a longer side of more pixels are reduced to it before detection."
    ),
]
Threads = Annotated[
    int,
    typer.Option(
        min=0,
        help="CPU threads; 0 for one per core.",
        callback=lambda count: count or available_threads(),
    ),
]
NoSeal = Annotated[
    bool, typer.Option("--no-seal", help="Write the learning map only, no sealed one.")
]
TracksFiles = Annotated[
    list[Path],
    typer.Argument(
        metavar="TRACKS", help="Tracks files that `protomark tracks` wrote, one per sequence."
    ),
]


def chosen_options(ctx: typer.Context) -> frozenset[str]:
    """Names of the options that the user gave, not left at their defaults."""
    sources = {name: ctx.get_parameter_source(name) for name in ctx.params}
    return frozenset(n for n, s in sources.items() if s is not None and s.name != "DEFAULT")
