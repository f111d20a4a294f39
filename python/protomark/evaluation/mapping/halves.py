"""The second half of a sequence localized in a map of its first half, by each kind of map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import protomark as pm
from protomark.console import track
from protomark.evaluation.mapping.results import Recall
from protomark.evaluation.mapping.variants import TRADITIONAL, Variant
from protomark.localization import halves
from protomark.localization.results import THRESHOLDS
from protomark.tracks.file import Tracks

# Metres and degrees of the target.
_NEAR = (0.05, 5)


def recalls(
    path: Path,
    calibrate: Sequence[Path],
    variants: Sequence[Variant],
    encoder: str = "",
    frames: int = 0,
) -> list[Recall]:
    """Recall at 5 cm and 5 degrees of each variant, see `protomark.localization.halves`.

    Args:
        path: tracks file, its true poses in metres.
        calibrate: tracks files of other sequences, which say which matches a map accepts.
        variants: kinds of map.
        encoder: name or file; empty: the descriptor's own.
        frames: ask for at most so many frames, spread over the second half; 0: all.
    """
    tracks = Tracks.load(path)
    later = len(tracks.keyframe_names) // 2
    stride = -(-later // frames) if frames else 1
    others = [Tracks.load(one) for one in calibrate]
    model = pm.Encoder.load(encoder or tracks.descriptor)
    at = THRESHOLDS.index(_NEAR)
    found = []
    for variant in track(variants, "localizing"):
        kind = _kind(variant, model)
        accepted = halves.calibrated(kind, others)
        result, _ = halves.localize_halves(tracks, kind, accepted, stride=stride)
        found.append(
            Recall(variant.name, result.recall[at], result.frames, result.bytes_per_landmark)
        )
    return found


def _kind(variant: Variant, encoder: pm.Encoder) -> halves.Variant:
    if variant.memory == "prototypes":
        return halves.prototypes(encoder, variant.dim)
    return halves.traditional() if variant.name == TRADITIONAL else halves.medoids()
