"""Which matches of an encoder to accept, fitted to frames whose landmarks are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.acceptance import Acceptance, features, with_acceptance
from protomark.build import check_descriptor
from protomark.console import console, track
from protomark.evaluation import pose
from protomark.evaluation.protocol import split
from protomark.evaluation.run import draw_frames, positions_of
from protomark.logistic import fit
from protomark.matching import MIN_PROBABILITY
from protomark.tracks.file import Tracks, sequence_name
from protomark.upright import SUFFIX, upright_tracks

FRAMES = 40
Search = Callable[[NDArray[np.uint8]], tuple[NDArray[np.int64], NDArray[np.int32]]]


@dataclass(frozen=True)
class Answers:
    """What a map answered to all keypoints of some frames, with and without landmark.

    Attributes:
        distances: (n, 2) float64, squared, to the two nearest landmarks.
        right: (n,) bool, whether the nearest is the keypoint's own, or projects to within half a
            percent of the image's longer side.
        frame: (n,) int64, which frame each keypoint is of.
    """

    distances: NDArray[np.float64]
    right: NDArray[np.bool_]
    frame: NDArray[np.int64]


def answers(tracks: Tracks, frames: Sequence[pose.Frame], search: Search) -> Answers:
    """Ask a map of `tracks` for every keypoint of `frames`."""
    distances, right, number = [], [], []
    for i, frame in enumerate(frames):
        found, away = search(frame.descriptors)
        rows = np.flatnonzero(found[:, 0] >= 0)
        matches = pose.Matches(rows, found[rows, 0])
        right.append(pose.right(frame, matches, positions_of(tracks, matches.landmarks)))
        distances.append(away[rows, :2].astype(np.float64))
        number.append(np.full(len(rows), i))
    return Answers(np.concatenate(distances), np.concatenate(right), np.concatenate(number))


def fit_acceptance(sequences: Sequence[Answers]) -> Acceptance:
    """The probability that fits the answers of some sequences best, each counting alike.

    Raises:
        ValueError: no answer is right, or all are.
    """
    distances = np.concatenate([a.distances for a in sequences])
    right = np.concatenate([a.right for a in sequences])
    weights = np.concatenate([np.full(len(a.right), 1 / len(a.right)) for a in sequences])
    fitted = fit(features(distances[:, 0], distances[:, 1]), right, weights)
    return Acceptance(tuple(float(w) for w in fitted))


def held_out(
    tracks: Tracks, frames: int = FRAMES, seed: int = 0
) -> tuple[NDArray[np.int64], list[pose.Frame]]:
    """Rows of the observations that build a map, and frames to ask it.

    A random tenth of the keyframes asks, as in `protomark evaluate`.

    Raises:
        ValueError: the tracks are too few or too short.
    """
    part = split(tracks, seed)
    return part.support_rows, draw_frames(tracks, part, frames)


def encoder_answers(
    encoder: pm.Encoder, tracks: Tracks, frames: int = FRAMES, seed: int = 0, threads: int = 1
) -> dict[int, Answers]:
    """Answers of maps of `tracks` by each length of the encoder's codes."""
    check_descriptor(tracks, encoder)
    rows, asked = held_out(tracks, frames, seed)
    codes = encoder.encode(tracks.descriptors[rows], threads=threads)
    found = {}
    for dim in encoder.dims:
        scene = pm.PrototypeMap(encoder, dim)
        scene.add_codes(tracks.landmark_of_keypoint[rows], np.ascontiguousarray(codes[:, :dim]))
        found[dim] = answers(tracks, asked, partial(scene.search, threads=threads))
    return found


@dataclass(frozen=True)
class Figures:
    """How well acceptance fits one sequence that it was not fitted to (or was the only one).

    Attributes:
        sequence: its name.
        dim: length of a code.
        right: share of keypoints whose nearest landmark is right.
        precision: share of right matches among those accepted.
        recall: share of right matches that are accepted.
        expected: mean probability of the accepted ones, to hold beside `precision`.
    """

    sequence: str
    dim: int
    right: float
    precision: float
    recall: float
    expected: float

    def as_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)


def measure(sequence: str, dim: int, acceptance: Acceptance, given: Answers) -> Figures:
    """Figures of the matches that are accepted of one sequence's answers."""
    probability = acceptance.probability(given.distances)
    taken = probability >= MIN_PROBABILITY
    right = given.right[taken]
    return Figures(
        sequence,
        dim,
        float(given.right.mean()),
        float(right.mean()) if len(right) else 0.0,
        float(right.sum() / max(given.right.sum(), 1)),
        float(probability[taken].mean()) if len(right) else 0.0,
    )


def calibrate(
    encoder: pm.Encoder, paths: Sequence[Path], threads: int = 1
) -> tuple[pm.Encoder, list[Figures]]:
    """The encoder with what to accept in its notes, and how well that fits each sequence.

    Each sequence's figures are of a fit to the others, where there are any.

    Args:
        encoder: the encoder.
        paths: tracks files of its descriptor (those of the plain one, if it is an upright encoder).
        threads: threads to encode and search on.

    Raises:
        FileNotFoundError, ValueError: a file is missing or broken, or is of another descriptor.
    """
    found: dict[str, dict[int, Answers]] = {}
    for path in track(paths, "asking maps"):
        tracks = Tracks.load(path)
        if encoder.descriptor == tracks.descriptor + SUFFIX:
            tracks = upright_tracks(tracks)
        name = sequence_name(path)
        if name in found:
            raise ValueError(f"{path}: two files are of the sequence {name}")
        try:
            found[name] = encoder_answers(encoder, tracks, threads=threads)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    figures = []
    for name in found:
        others = [given for other, given in found.items() if other != name] or [found[name]]
        for dim in encoder.dims:
            held = fit_acceptance([given[dim] for given in others])
            figures.append(measure(name, dim, held, found[name][dim]))
    fitted = {dim: fit_acceptance([g[dim] for g in found.values()]) for dim in encoder.dims}
    return with_acceptance(encoder, fitted, ", ".join(found)), figures


def calibrate_file(
    model: Path, paths: Sequence[Path], output: Path, threads: int = 1
) -> list[Figures]:
    """Calibrate a model file and write it to `output`; see `calibrate`."""
    encoder, figures = calibrate(pm.Encoder.load(model), paths, threads)
    encoder.save(output)
    return figures


def show(figures: Sequence[Figures]) -> None:
    """Print the figures."""
    from rich.table import Table

    table = Table("sequence", "dim", "right of all", "precision", "expected", "recall")
    for f in figures:
        shares = (f.right, f.precision, f.expected, f.recall)
        table.add_row(f.sequence, str(f.dim), *(f"{share:.3f}" for share in shares))
    console.print(table)
    console.print(
        f"Accepted with a probability of {MIN_PROBABILITY:g} or more; each sequence by a fit to "
        "the others"
    )
