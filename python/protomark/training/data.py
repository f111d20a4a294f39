"""Reads tracks for training, and checks them before the first step."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from protomark.features.descriptors import InputKind
from protomark.progress import Progress, silent, tracked
from protomark.tracks.file import Tracks, sequence_name
from protomark.training.sampling import Views
from protomark.training.validation import Trial

MIN_BITS = 64
MAX_BITS = 1024
REPORT_SEEDS = (0, 1, 2)
# Number of landmarks with 3 or more views that training needs.
MIN_LANDMARKS = 500


@dataclass(frozen=True)
class TrainingSource:
    """A tracks file in the card."""

    name: str  # file name up to its first dot
    file: str  # file name
    # keyframes, landmarks, observations: their numbers.
    keyframes: int
    landmarks: int
    observations: int
    licence: str  # licence that the user or the tracks' `info` states, else ""


@dataclass(frozen=True)
class TrainingData:
    """The data of a training."""

    descriptor: str  # name of the descriptor of all tracks
    bits: int  # length of a descriptor
    input: InputKind  # what the descriptors are
    views: list[Views]  # training sequences
    trials: list[Trial]  # splits of the validation sequences
    sources: list[TrainingSource]  # the training files
    validation_sources: list[TrainingSource]  # the validation files
    fingerprint: str  # SHA-256 of all descriptors and landmarks, hexadecimal


def read_tracks(path: Path, upright: bool) -> Tracks:
    """Load tracks, with plain or upright descriptors (`protomark.features.upright`)."""
    tracks = Tracks.load(path)
    return tracks.upright() if upright else tracks


def hold_out(training: Sequence[Path], validation: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """The files to train on, and those to validate on: by default the last one."""
    if validation:
        return list(training), list(validation)
    if len(training) < 2:
        raise ValueError(
            f"{training[0]}: one tracks file cannot serve for training and validation: give "
            "another sequence with --validation"
        )
    return list(training[:-1]), [training[-1]]


def load_trials(
    tracks: Tracks, path: Path, seeds: Sequence[int], max_queries: int = 10_000
) -> list[Trial]:
    """Splits of a sequence, one per seed."""
    return [Trial.from_tracks(tracks, sequence_name(path), s, max_queries) for s in seeds]


def load_training(
    training: Sequence[Path],  # tracks files to train on
    validation: Sequence[Path],  # tracks files that select the model, none of them in `training`
    seeds: Sequence[int] = (0,),  # seeds of the splits of each validation sequence
    max_queries: int = 5_000,  # limit on queries per split
    licences: Mapping[str, str] | None = None,  # licences of the sequences by name, for the card
    upright: bool = False,  # whether to train on angles and sizes of keypoints, too
    report: Sequence[Path] = (),  # tracks files to measure the encoder on
    progress: Progress = silent,
) -> TrainingData:
    """Read and check training and validation tracks."""
    if not training:
        raise ValueError("there are no training tracks: give at least one tracks file")
    if not validation:
        raise ValueError("there are no validation tracks: give a file with --validation")
    both = {p.resolve() for p in training} & {p.resolve() for p in validation}
    if both:
        raise ValueError(
            f"{sorted(both)[0].name} is given for training and for validation: "
            "validate on a sequence that is not trained on"
        )
    licences = licences or {}
    unknown = set(licences) - {sequence_name(p) for p in [*training, *validation]}
    if unknown:
        raise ValueError(
            f"a licence is given for {min(unknown)}, which is not one of the sequences: "
            "name a sequence by its file name up to the first dot"
        )
    kind: tuple[str, InputKind, int] | None = None
    views: list[Views] = []
    trials: list[Trial] = []
    sources: list[TrainingSource] = []
    learned: dict[str, str] = {}  # training files by the digest of their input
    digest = hashlib.sha256()
    known = len(training) + len(validation)
    for i, path in enumerate(tracked([*training, *validation, *report], progress, "read tracks")):
        tracks = read_tracks(path, upright)
        if kind is None:
            kind = (tracks.descriptor, tracks.input, tracks.bits)
            if tracks.input == "bits" and not MIN_BITS <= tracks.bits <= MAX_BITS:
                raise ValueError(
                    f"{path} has descriptors of {tracks.bits} bits: encoders are trained for "
                    f"{MIN_BITS} to {MAX_BITS} bits"
                )
        elif (tracks.descriptor, tracks.input, tracks.bits) != kind:
            raise ValueError(
                f"{path} has {tracks.descriptor} descriptors of {tracks.bits} bits "
                f"({tracks.input}), but {training[0]} has {kind[0]} of {kind[2]} ({kind[1]}): give "
                "tracks of one descriptor"
            )
        if i >= known:
            load_trials(tracks, path, REPORT_SEEDS)  # whether it can be measured at the end
            continue
        made_from = str(tracks.info.get("input", ""))
        if i < len(training):
            learned[made_from] = path.name
        elif made_from and made_from in learned:
            # Augmented and plain tracks are files of the same sequence.
            raise ValueError(
                f"{path.name} and {learned[made_from]} are of the same images: validate on a "
                "sequence that is not trained on"
            )
        digest.update(tracks.descriptors.tobytes())
        digest.update(tracks.landmark_of_keypoint.tobytes())
        sources.append(_source(tracks, path, licences))
        if i < len(training):
            found = Views.from_tracks(tracks, sequence_name(path))
            if not (found.counts >= 3).any():
                raise ValueError(
                    f"{path}: no landmark has the 3 views that training needs: make longer tracks "
                    "or leave the file out"
                )
            views.append(found)
        else:
            trials += load_trials(tracks, path, seeds, max_queries)
    learnable = int(sum((v.counts >= 3).sum() for v in views))
    if learnable < MIN_LANDMARKS:
        raise ValueError(
            f"only {learnable} landmarks have 3 or more views, but training needs "
            f"{MIN_LANDMARKS}: give more or longer tracks"
        )
    assert kind is not None
    return TrainingData(
        kind[0],
        kind[2],
        kind[1],
        views,
        trials,
        sources[: len(training)],
        sources[len(training) :],
        digest.hexdigest(),
    )


def _source(tracks: Tracks, path: Path, licences: Mapping[str, str]) -> TrainingSource:
    name = sequence_name(path)
    return TrainingSource(
        name,
        path.name,
        len(tracks.keyframe_names),
        len(np.unique(tracks.landmark_of_keypoint[tracks.observations])),
        len(tracks.observations),
        licences.get(name) or str(tracks.info.get("licence", "")),
    )
