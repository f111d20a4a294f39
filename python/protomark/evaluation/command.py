"""`protomark evaluate`: files in; tables, JSON, Markdown and a plot out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from protomark.console import console, progress_bar, progress_console
from protomark.evaluation.methods import choices, choose
from protomark.evaluation.plot import check_ending, save_plot
from protomark.evaluation.report import caption, markdown, rich_table
from protomark.evaluation.results import SequenceResult, mean_rows, save_json
from protomark.evaluation.run import Options, evaluate
from protomark.evaluation.support import Moments, Support
from protomark.files import write_text
from protomark.inputs import lacking, lengthen, option
from protomark.tracks.file import Tracks, sequence_name

if TYPE_CHECKING:
    import protomark as pm


def evaluate_files(
    paths: Sequence[Path],
    options: Options,
    *,
    encoders: Sequence[str] = (),
    methods: Sequence[str] = (),
    discriminant_from: Sequence[Path] = (),
    inputs: str = "",
) -> list[SequenceResult]:
    """Evaluate tracks files one after the other, printing each table as soon as it is there.

    Args:
        paths: tracks files.
        options: seeds, frames and threads.
        encoders: names or paths; a file is evaluated with those of its descriptor. None given:
            the one that ships for it.
        methods: names of methods, or of families of methods; none given: the default ones.
        discriminant_from: tracks files to learn the linear discriminants from; none given: from
            each sequence's own support.
        inputs: of keypoints that only Protomark's own methods get, see `protomark.inputs`.

    Raises:
        FileNotFoundError, ValueError: a file is missing, broken, or does not fit the others.
    """
    loaded = load_encoders(encoders)
    for path in [*paths, *discriminant_from]:
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such tracks file")
    learned: dict[tuple[str, int], Moments | None] = {}
    results = []
    for path in paths:
        tracks = Tracks.load(path)
        longer = lengthen(tracks, inputs)
        fitting = encoders_for(longer, loaded, given=bool(encoders))
        kind = (tracks.descriptor, tracks.bits)
        if kind not in learned:
            learned[kind] = learn(discriminant_from, tracks) if discriminant_from else None
        chosen = choose(choices(fitting, learned[kind], options.threads), methods)
        name = sequence_name(path)
        with _progress(name, len(chosen) * len(options.seeds)) as advance:
            result = evaluate(
                tracks,
                name,
                chosen,
                options,
                own=longer,
                discriminant=", ".join(p.name for p in discriminant_from) or "support",
                advance=advance,
            )
        console.print(rich_table(caption(result), result.rows()))
        results.append(result)
    for descriptor in dict.fromkeys(result.descriptor for result in results):
        same = [result for result in results if result.descriptor == descriptor]
        if len(same) > 1:
            title = f"{descriptor.upper()}: mean of {len(same)} sequences"
            console.print(rich_table(title, mean_rows(same)))
    return results


@contextmanager
def _progress(name: str, steps: int) -> Iterator[Callable[[str], None]]:
    """A bar that a call with a label moves on by a step."""
    with progress_bar() as progress:
        task = progress.add_task(name, total=steps)
        yield lambda label: progress.update(task, advance=1, description=f"{name}: {label}")


def write(
    results: Sequence[SequenceResult],
    json_path: Path | None,
    markdown_path: Path | None,
    plot_path: Path | None,
) -> None:
    """Write what was asked for; the plot shows the mean where there are several sequences."""
    if json_path:
        save_json(results, json_path)
    if markdown_path:
        write_text(markdown_path, markdown(results))
    if plot_path:
        for descriptor, path in plot_paths(results, plot_path).items():
            same = [result for result in results if result.descriptor == descriptor]
            rows = mean_rows(same) if len(same) > 1 else same[0].rows()
            names = ", ".join(result.sequence for result in same)
            save_plot(rows, path, f"{descriptor.upper()}: {names}")


def check_outputs(*paths: Path | None) -> None:
    """Raise before any work if a result could not be written after it."""
    for path in paths:
        if path is None:
            continue
        if path.is_dir():
            raise ValueError(f"{path} is a folder: name a file to write")
        if not path.parent.is_dir():
            raise FileNotFoundError(f"{path.parent}: no such folder to write {path.name} to")


def check_plot(path: Path | None) -> None:
    """Raise before any work if the ending is not one of a picture."""
    if path is not None:
        check_ending(path)


def plot_paths(results: Sequence[SequenceResult], path: Path) -> dict[str, Path]:
    """Descriptor -> file; with several descriptors each one's name is put into the file's."""
    descriptors = list(dict.fromkeys(result.descriptor for result in results))
    if len(descriptors) == 1:
        return {descriptors[0]: path}
    return {name: path.with_name(f"{path.stem}.{name}{path.suffix}") for name in descriptors}


def load_encoders(sources: Sequence[str]) -> list[pm.Encoder]:
    """The encoders of these names or paths; none given: all that ship."""
    import protomark as pm
    from protomark import models

    return [pm.Encoder.load(source) for source in sources or models.names()]


def encoders_for(
    tracks: Tracks, encoders: Sequence[pm.Encoder], *, given: bool
) -> list[pm.Encoder]:
    """The encoders that take the descriptors of the tracks; says so if there is none.

    Without encoders that the user named, this is the one that is named like the descriptor.
    """
    fitting = [
        encoder
        for encoder in encoders
        if (encoder.descriptor, encoder.bits) == (tracks.descriptor, tracks.bits)
        and (given or encoder.name == tracks.descriptor)
    ]
    if not fitting:
        whose = "none of the encoders given is" if given else "no encoder ships"
        longer = [i for e in encoders if (i := lacking(tracks.descriptor, e.descriptor))]
        remedy = (
            f"give {option(longer[0])}" if given and longer else "train one with `protomark train`"
        )
        progress_console.print(
            f"note: {whose} for {tracks.descriptor} with {tracks.bits} bits; "
            f"only the other methods are compared ({remedy})",
            highlight=False,
            soft_wrap=True,
        )
    return fitting


def learn(paths: Sequence[Path], like: Tracks) -> Moments:
    """Moments over the tracks files together, landmarks with at least two observations."""
    import numpy as np

    landmarks, descriptors, at = [], [], 0
    for path in paths:
        tracks = Tracks.load(path)
        if (tracks.descriptor, tracks.bits) != (like.descriptor, like.bits):
            raise ValueError(
                f"{path}: holds {tracks.descriptor} with {tracks.bits} bits, the tracks to "
                f"evaluate {like.descriptor} with {like.bits}: give tracks of the same descriptor"
            )
        rows = tracks.observations
        index = np.searchsorted(tracks.landmark_ids, tracks.landmark_of_keypoint[rows])
        often = np.bincount(index, minlength=len(tracks.landmark_ids))[index] >= 2
        landmarks.append(index[often] + at)
        descriptors.append(tracks.descriptors[rows[often]])
        at += len(tracks.landmark_ids)
    return Support(np.concatenate(landmarks), np.concatenate(descriptors)).moments
