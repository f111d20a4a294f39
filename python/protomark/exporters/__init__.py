"""Writes maps and tracks in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from protomark.files import check_elsewhere, check_outputs, replacing_folder
from protomark.maps.info import is_tracks
from protomark.tracks.file import Tracks

Format = Literal["ply", "colmap", "kapture", "nerfstudio", "stella"]


def export(source: Path, output: Path, to: Format, images: Path | None = None) -> dict[str, Any]:
    """Write a scene for another program; returns facts as JSON values.

    Args:
        source: a folder of `protomark map`, a map file (for ply), or tracks.
        output: for ply and stella the file to write, else a new folder.
        to: the format.
        images: folder of the images, which give landmarks their colours.

    Raises:
        FileExistsError: the output folder holds files.
        FileNotFoundError, ValueError: the source lacks what the format needs.
    """
    if to in ("ply", "stella"):
        check_outputs(output, inputs=[source])
    else:
        check_outputs(folder=output)
        check_elsewhere(output)
        if output.exists() and any(output.iterdir()):
            raise FileExistsError(f"{output} holds files: name a new folder with -o")
    tracks = Tracks.load(source) if is_tracks(source) else None
    if to in ("stella", "kapture"):
        program = "stella_vslam" if to == "stella" else to
        if images is not None:
            raise ValueError(f"maps of {program} have no colours: leave out --images")
        if tracks is None:
            raise ValueError(f"{source} holds no descriptors, which {program} needs: give tracks")
        if to == "stella":
            from protomark.exporters.stella import write_stella

            return write_stella(tracks, output)
        from protomark.tracks.importers.kapture import write_kapture

        output.parent.mkdir(parents=True, exist_ok=True)
        with replacing_folder(output.resolve()) as folder:
            write_kapture(tracks, folder)
        return {
            "keyframes": len(tracks.keyframe_names),
            "landmarks": len(tracks.landmark_ids),
            "observations": len(tracks.observations),
        }
    if to == "ply" and images is None:
        from protomark.exporters.ply import landmarks_of, write_ply

        return write_ply(output, *landmarks_of(source, tracks))
    from protomark.exporters.colmap import coloured_points, reconstruction_of, write_colmap

    reconstruction = reconstruction_of(source, tracks, images)
    if to == "colmap":
        return write_colmap(reconstruction, output)
    if to == "ply":
        from protomark.exporters.ply import write_ply

        return write_ply(output, *coloured_points(reconstruction))
    from protomark.exporters.nerfstudio import write_nerfstudio

    return write_nerfstudio(reconstruction, output, images)
