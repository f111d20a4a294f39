"""Merges two halves of each map that another program wrote, and tries to merge different maps.

python benchmarks/scripts/merge_foreign.py MAP... [--part 0.6]

A MAP is whatever `protomark build` takes. The first and the last --part of its keyframes become
maps of their own: landmarks are numbered anew, and the second half is turned, scaled and moved at
random. The table says how well `protomark merge` finds that motion (error of the second half's
landmarks, as a share of the map's extent). Then it tries all pairs of first halves.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np

import protomark as pm
from protomark.geometry.similarity import Similarity
from protomark.maps.alignment import align_maps
from protomark.maps.build import build_map
from protomark.maps.sources import read_places
from protomark.tracks.file import Tracks
from protomark_bench.report import ReportTable

HEADS = ("map", "landmarks", "shared", "agree", "of likely", "duplicates", "right", "error", "s")


def half(tracks: Tracks, chosen: range, rng: np.random.Generator) -> tuple[Tracks, np.ndarray]:
    """The observations of some keyframes with landmarks numbered anew, and the new ids."""
    kept = tracks.where(np.isin(tracks.keyframe_of_keypoint, chosen))
    ids = rng.permutation(len(tracks.landmark_ids)).astype(np.int64)
    labels = kept.landmark_of_keypoint.copy()
    seen = labels >= 0
    labels[seen] = ids[np.searchsorted(tracks.landmark_ids, labels[seen])]
    positions = np.empty_like(tracks.landmark_positions)
    positions[ids] = tracks.landmark_positions
    numbers = np.arange(len(ids), dtype=np.int64)
    return replace(
        kept, landmark_of_keypoint=labels, landmark_ids=numbers, landmark_positions=positions
    ), ids


def random_similarity(rng: np.random.Generator, extent: float) -> Similarity:
    """A random rotation, a scale from 0.5 to 2, and a translation of up to some extents."""
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    return Similarity(float(np.exp(rng.uniform(-0.7, 0.7))), rotation, rng.normal(size=3) * extent)


def main() -> None:
    """Split, merge and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("maps", type=Path, nargs="+")
    parser.add_argument("--part", type=float, default=0.6, help="share of the keyframes in a half")
    args = parser.parse_args()
    rows: list[tuple[str, ...]] = []
    scenes: list[tuple[str, pm.PrototypeMap]] = []
    for path in args.maps:
        rng = np.random.default_rng(0)
        tracks = read_places([path])
        encoder = pm.Encoder.load(tracks.encoder_name)
        n = len(tracks.keyframe_names)
        count = round(args.part * n)
        (one, one_ids), (other, other_ids) = (
            half(tracks, r, rng) for r in (range(count), range(n - count, n))
        )
        box = np.percentile(tracks.landmark_positions, (1, 99), axis=0)
        extent = float(np.linalg.norm(box[1] - box[0]))
        motion = random_similarity(rng, extent)
        other = replace(other, landmark_positions=motion(other.landmark_positions))
        first, second = (build_map(t, encoder, min_observations=1) for t in (one, other))
        scenes.append((encoder.identity, first))
        shared = len(np.intersect1d(one_of(one_ids, first), one_of(other_ids, second)))
        started = time.perf_counter()
        facts = path.name, f"{len(tracks.landmark_ids):,}", f"{shared:,}"
        try:
            found = align_maps(first, second)
        except ValueError as problem:
            rows.append((*facts, f"refused: {problem}", *[""] * 5))
            continue
        seconds = time.perf_counter() - started
        true = np.empty(len(one_ids), np.int64)
        true[other_ids] = one_ids
        right = float((true[found.source] == found.into).mean())
        back = found.similarity(second.positions(second.ids))
        error = np.linalg.norm(back - motion.inverse()(second.positions(second.ids)), axis=1)
        said = "refused: " + found.problem if found.problem else f"{found.agreeing:,}"
        rows.append(
            (
                *facts,
                said,
                f"{found.likely:,}",
                f"{len(found.source):,}",
                f"{right:.1%}",
                f"{np.sqrt(np.mean(error**2)) / extent:.3%}",
                f"{seconds:.1f}",
            )
        )
    print(ReportTable(HEADS, rows).markdown())
    tried = joined = 0
    for (i, (ours, first)), (j, (theirs, second)) in permutations(list(enumerate(scenes)), 2):
        if ours != theirs:
            continue
        tried += 1
        try:
            alike = align_maps(first, second)
        except ValueError:
            continue
        if not alike.problem:
            joined += 1
            print(f"{args.maps[i].name} and {args.maps[j].name} are merged: {alike.facts()}")
    print(f"{joined} of {tried} pairs of different maps are merged")


def one_of(ids: np.ndarray, scene: pm.PrototypeMap) -> np.ndarray:
    """Which landmarks of the whole map `scene` has."""
    number = np.empty(len(ids), np.int64)
    number[ids] = np.arange(len(ids))
    return number[scene.ids]


if __name__ == "__main__":
    main()
