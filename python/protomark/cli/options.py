"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

JsonFile = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Write the results to this JSON file, too."),
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
MaxKeypoints = Annotated[
    int,
    typer.Option(min=4, help="Limit on keypoints per image: the strongest, spread over the image."),
]
Threads = Annotated[int, typer.Option(min=0, help="CPU threads; 0 for one per core.")]
