"""Writes maps and tracks in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from protomark.files import check_elsewhere, check_outputs, replacing_folder
from protomark.maps.info import is_tracks
from protomark.tracks.file import Tracks
from protomark.tracks.importers import find_importer

Format = Literal["ply", "colmap", "kapture", "nerfstudio", "orbslam3", "stella"]
FILES = ("ply", "orbslam3", "stella")  # formats of one file
_PROGRAMS = {"kapture": "kapture", "orbslam3": "ORB-SLAM3", "stella": "stella_vslam"}


def export(source: Path, output: Path, to: Format, images: Path | None = None) -> dict[str, Any]:
    """Write a scene for another program; returns facts as JSON values.

    Args:
        source: a folder of `protomark map`, a map file (for ply), tracks, or a map of another
            program; for orbslam3 an atlas, of which all is kept but descriptors.
        output: for ply, orbslam3 and stella the file to write, else a new folder.
        to: the format.
        images: folder of the images, which give landmarks their colours.

    Raises:
        FileExistsError: the output folder holds files.
        FileNotFoundError, ValueError: the source lacks what the format needs.
    """
    if to in FILES:
        check_outputs(output, inputs=[source])
    else:
        check_outputs(folder=output)
        check_elsewhere(output)
        if output.exists() and any(output.iterdir()):
            raise FileExistsError(f"{output} holds files: name a new folder with -o")
    if to in _PROGRAMS and images is not None:
        raise ValueError(f"maps of {_PROGRAMS[to]} have no colours: leave out --images")
    importer = None if is_tracks(source) else find_importer(source)
    if to == "orbslam3":
        from protomark.exporters.orbslam3 import write_orbslam3

        if not importer or importer.__name__.rpartition(".")[2] != to:
            raise ValueError(
                f"{source} is no atlas of ORB-SLAM3, whose other content is kept: give one (.osa)"
            )
        return write_orbslam3(source, output)
    tracks: Tracks | None = None
    if importer or is_tracks(source):
        tracks = importer.read(source) if importer else Tracks.load(source)
        worlds = len(tracks.info.get("source", {}).get("maps", []))
        if worlds > 1:
            raise ValueError(
                f"{source} holds {worlds} maps, each in coordinates of its own, but {to} has one "
                "world: give a source of one map"
            )
    if to in _PROGRAMS:
        if tracks is None:
            raise ValueError(
                f"{source} holds no descriptors, which {_PROGRAMS[to]} needs: give tracks, or a "
                "map of another program"
            )
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
