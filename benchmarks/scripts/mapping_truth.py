"""Maps sequences with and without their camera, by Protomark and by COLMAP, beside the truth.

    python benchmarks/scripts/mapping_truth.py SEQUENCE[:SLICE] ... [--no-colmap]

SEQUENCE is a folder with images/ and a COLMAP model of the true poses in true/ or sparse/;
kitchen:120 takes its first 120 images, kitti07:64: all from the 65th on. Prints a Markdown row for
each run: frames registered, root mean square distance of the camera centres after the best
similarity, and CPU seconds of one thread. COLMAP has SIFT and its defaults, as in `protomark
evaluate-mapping`.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from protomark.geometry.colmap import find_model, pycolmap, quiet, read_model
from protomark_bench.mapping.colmap import _match
from protomark_bench.mapping.sequences import error

HEADS = ("scene", "camera", "by", "registered", "error", "% of extent", "focal", "CPU s")


def protomark(images: Path, camera: str, output: Path) -> tuple[int, str, float]:
    """Exit code, focal length and CPU seconds of `protomark map`."""
    given = ["--camera", camera] if camera else []
    command = [sys.executable, "-m", "protomark", "map", str(images), "-o", str(output), *given]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, "--no-seal"], env=environment, capture_output=True, check=False
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    report = output / "report.json"
    focal = json.loads(report.read_text())["camera"]["params"][0] if report.exists() else np.nan
    return done.returncode, f"{focal:.0f}", seconds


def colmap(images: Path, camera: str, output: Path) -> tuple[int, str, float]:
    """Number of models but one, focal length and CPU seconds of COLMAP; writes the largest."""
    reader = pycolmap.ImageReaderOptions()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = 0
    options.num_threads = options.mapper.num_threads = 1
    reader.camera_model = "SIMPLE_RADIAL"
    if camera:
        model, _, _, *params = camera.split()
        reader.camera_model, reader.camera_params = model, ",".join(params)
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        for bounds in (options, options.mapper, options.triangulation):
            bounds.max_extra_param = 1e12
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = 1
    database, started = output.parent / "database.db", time.process_time()
    with quiet():
        pycolmap.extract_features(
            database,
            images,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
        _match(database, len(list(images.iterdir())), 1)
        models = pycolmap.incremental_mapping(database, images, output.parent, options=options)
    seconds = time.process_time() - started
    if not models:
        return 1, "–", seconds
    best = max(models.values(), key=lambda m: m.num_reg_images())
    (output / "sparse").mkdir(parents=True)
    best.write(output / "sparse")
    (lens,) = {c.mean_focal_length() for c in best.cameras.values()}
    return len(models) - 1, f"{lens:.0f}", seconds


def main() -> None:
    """Print one row per sequence, camera and system."""
    print("| " + " | ".join(HEADS) + " |\n|" + " --- |" * len(HEADS), flush=True)
    systems = (protomark,) if "--no-colmap" in sys.argv else (protomark, colmap)
    for name in (a for a in sys.argv[1:] if not a.startswith("--")):
        folder, *bounds = name.split(":")
        path = Path(folder)
        true = read_model(find_model(path / "true" if (path / "true").is_dir() else path))
        centers = {n: c.tolist() for n, c in zip(true.names, true.centers, strict=True)}
        lens = next(iter(true.cameras.values()))
        with tempfile.TemporaryDirectory() as temporary:
            images = Path(temporary) / "images"
            images.mkdir()
            chosen = slice(*(int(b) if b else None for b in bounds or [""]))
            names = sorted(p.name for p in (path / "images").iterdir())[chosen]
            for image in names:
                (images / image).symlink_to((path / "images" / image).resolve())
            extent = float(np.linalg.norm(np.ptp([centers[n] for n in names], axis=0)))
            for camera in (str(lens), ""):
                for system in systems:
                    output = Path(temporary) / f"{system.__name__}{len(camera)}" / "map"
                    output.parent.mkdir()
                    code, focal, seconds = system(images, camera, output)
                    row = [path.name, "given" if camera else "none", system.__name__, "0", "–", "–"]
                    if (output / "sparse").is_dir():
                        model = read_model(output / "sparse")
                        found = {
                            n: c.tolist() for n, c in zip(model.names, model.centers, strict=True)
                        }
                        off = error(found, centers) or np.nan
                        row[3:] = f"{len(found)} of {len(names)}", f"{off:.4f}"
                        row.append(f"{100 * off / extent:.2f}")
                    if code:
                        row[2] += " (not trusted)" if system is protomark else " (in parts)"
                    print("| " + " | ".join([*row, focal, f"{seconds:.0f}"]) + " |", flush=True)


if __name__ == "__main__":
    main()
