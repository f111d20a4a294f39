"""The command `protomark align`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from protomark.cli.options import JsonFile


def align(
    scene: Annotated[
        Path,
        typer.Argument(
            metavar="SCENE", help="Folder of `protomark map`, or a learning map to scale."
        ),
    ],
    to: Annotated[
        Path | None,
        typer.Option(
            help="Camera positions: a text or CSV file of image name, x, y, z (or, with a header, "
            "lat, lon, alt), a COLMAP model or images.txt, or a TUM trajectory. Or control points: "
            "image name, x, y in pixels, X, Y, Z and maybe a name, or a gcp_list.txt (OpenSfM)."
        ),
    ] = None,
    scale: Annotated[
        float | None, typer.Option(help="Multiply all lengths, for example to get metres.")
    ] = None,
    up: Annotated[
        bool, typer.Option("--up", help="Turn z up, as most images say by their upper edges.")
    ] = False,
    frame: Annotated[
        str | None,
        typer.Option(help="The new world, for the map's metadata, for example 'ENU, metres'."),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Move a scene into another world, in place.

    The similarity that brings most cameras, or control points that two images show, close to their
    given positions moves the learning map,
    the sealed map, the COLMAP model and the trajectory together, or nothing at all.

    protomark align kitchen --to gps.csv

    protomark align kitchen --up --scale 1.23
    """
    from protomark.cli.terminal import note_outdated, progress_bar, write_json
    from protomark.files import check_outputs
    from protomark.interrupt import Interrupted
    from protomark.mapping.aligning import Target, align_scene

    target = Target(to, scale, up, frame)
    check_outputs(json_file, inputs=[scene, to])
    before = os.stat(scene).st_ino if scene.exists() else 0
    try:
        with progress_bar() as progress:
            facts = align_scene(scene, target, progress)
        write_json(json_file, facts)
        _show(facts)
        if scene.is_file():
            note_outdated(scene)
    except KeyboardInterrupt:
        # A scene moves by one rename at the end.
        if os.stat(scene).st_ino != before:
            raise Interrupted(f"stopped after all of {scene} had moved") from None
        raise


def _show(facts: dict[str, Any]) -> None:
    from protomark.cli.terminal import print_facts

    x, y, z = facts["translation"]
    rows = [
        ("scaled by", f"{facts['scale']:.6g}"),
        ("turned by", f"{facts['degrees']:.2f} degrees"),
        ("moved by", f"{x:.6g}, {y:.6g}, {z:.6g}"),
    ]
    if residuals := facts.get("residuals"):
        worst = sorted(residuals, key=residuals.__getitem__, reverse=True)[:3]
        rows += [
            (f"{facts['fitted']} that fit", f"{facts['inliers']} of {facts['given']}"),
            (
                "residuals",
                f"median {facts['residual_median']:.4g}, root mean square of those that fit "
                f"{facts['residual_rmse_of_inliers']:.4g}",
            ),
            ("largest", ", ".join(f"{name}: {residuals[name]:.4g}" for name in worst)),
        ]
    if facts.get("frame"):
        rows.append(("world", facts["frame"]))
    if facts["dropped_frame"] is not None:
        rows.append(("frame", f"{facts['dropped_frame']!r} is true no more: --frame says what is"))
    print_facts(rows)
