"""Merges maps of two halves of each sequence, and tries to merge maps of different places.

python benchmarks/scripts/merge_halves.py DATA MAPS castle toy kitchen:120 [--part 0.6]

Each sequence is the folder DATA/NAME with images/ and sparse/ (or true/); NAME:COUNT takes the
first COUNT images. The first and the last --part of its images are mapped apart, with unknown
cameras, and merged with their frames; so are all images together. Maps are kept in MAPS. The table
has the error of all camera centres against the sequence's poses after the best similarity, as a
share of the trajectory's extent. Every pair of halves of different sequences has to be refused, in
both orders.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from itertools import permutations
from pathlib import Path

import numpy as np

from protomark.cli.terminal import progress_bar
from protomark.features.images import image_names
from protomark.files import SCENE_MAP
from protomark.geometry.colmap import ColmapModel, find_model, read_model
from protomark.mapping.merging_maps import merge_folders
from protomark.mapping.options import MappingOptions
from protomark.mapping.request import MapRequest
from protomark.mapping.session import make_map
from protomark.maps.alignment import align_maps
from protomark.maps.open import open_learning_map
from protomark_bench.report import ReportTable
from protomark_bench.trajectory import trajectory_error

HEADS = ("sequence", "images", "agree", "of likely", "space", "s", "error", "error, one map")


def mapped(images: Path, names: list[str], scene: Path) -> Path:
    """The map of some images, made if there is none."""
    if not (scene / SCENE_MAP).is_file():
        folder = scene.with_name(f"{scene.name}.images")
        folder.mkdir(parents=True, exist_ok=True)
        for name in names:
            if not (folder / name).exists():
                os.symlink((images / name).resolve(), folder / name)
        with progress_bar(f"{scene.name}: ") as progress:
            make_map(MapRequest(folder, scene, MappingOptions(), seal=False), progress)
    return scene


def error_of(scene: Path, true: ColmapModel) -> tuple[float, int]:
    """Error of a map's cameras, as a share of the true extent, and the number of true ones found.

    Images that were mapped twice count twice.
    """
    model = read_model(find_model(scene))
    row = {name: i for i, name in enumerate(true.names)}
    names = [Path(name).name for name in model.names]
    known = [i for i, name in enumerate(names) if name in row]
    centers = true.centers[[row[names[i]] for i in known]]
    extent = float(np.linalg.norm(np.ptp(true.centers, axis=0)))
    error = trajectory_error(model.centers[known], centers).rmse / extent
    return error, len({names[i] for i in known})


def main() -> None:
    """Map, merge and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("maps", type=Path)
    parser.add_argument("sequences", nargs="+")
    parser.add_argument("--part", type=float, default=0.6, help="share of the images in a half")
    args = parser.parse_args()
    rows: list[tuple[str, ...]] = []
    halves: list[tuple[str, Path]] = []
    for name in args.sequences:
        sequence, _, limit = name.partition(":")
        source = args.data / sequence
        names = image_names(source / "images")[: int(limit) if limit else None]
        count = round(args.part * len(names))
        parts = [
            mapped(source / "images", chosen, args.maps / f"{name}.{label}")
            for chosen, label in ((names[:count], "a"), (names[-count:], "b"))
        ]
        halves += [(sequence, part) for part in parts]
        true = read_model(find_model(source / "true" if (source / "true").is_dir() else source))
        whole, _ = error_of(mapped(source / "images", names, args.maps / f"{name}.w"), true)
        started = time.perf_counter()
        try:
            with tempfile.TemporaryDirectory() as output:
                merged = merge_folders(parts, Path(output), seal=False)
                error, found = error_of(Path(output), true)
        except ValueError as problem:
            rows.append((name, f"refused: {problem}", *[""] * 5, f"{whole:.3%}"))
            continue
        facts = merged.facts["inputs"][1]["moved"]
        rows.append(
            (
                name,
                f"{found} of {len(names)}",
                f"{facts['agreeing']:,}",
                f"{facts['likely']:,}",
                f"{facts['cube_share']:.0%}",
                f"{time.perf_counter() - started:.0f}",
                f"{error:.3%}",
                f"{whole:.3%}",
            )
        )
    print(ReportTable(HEADS, rows).markdown())
    tried = false = 0
    for (one, first), (other, second) in permutations(halves, 2):
        if one == other:
            continue
        tried += 1
        try:
            alike = align_maps(open_learning_map(first), open_learning_map(second))
        except ValueError:
            continue
        if not alike.problem:
            false += 1
            print(f"{first.name} and {second.name} are merged: {alike.facts()}")
    print(f"{false} of {tried} pairs of maps of different sequences are merged")


if __name__ == "__main__":
    main()
