"""What `protomark evaluate-mapping` does: runs, targets, report."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import Progress, TaskID

import protomark as pm
from protomark.console import console, progress_bar, progress_console
from protomark.evaluation.mapping import figures
from protomark.evaluation.mapping.report import mark, markdown
from protomark.evaluation.mapping.results import Recall, Results, Run, SequenceResult
from protomark.evaluation.mapping.sequences import open_sequences
from protomark.evaluation.mapping.targets import targets
from protomark.evaluation.mapping.variants import COLMAP, Variant
from protomark.evaluation.threads import available_threads, one_blas_thread
from protomark.files import write_text
from protomark.kept import Kept, key_of

if TYPE_CHECKING:
    from protomark.evaluation.mapping.sequences import Sequence as Images
    from protomark.mapping.settings import Settings

REPORT, FIGURES, KEPT = "report.md", "report.json", "kept"


@dataclass(frozen=True)
class Request:
    """What is asked for.

    Attributes:
        sequences: folders with images/ and sparse/.
        output: folder of the report, and of what is kept for a next run.
        variants: what maps shall remember.
        base: all else about how they are made.
        colmap: whether COLMAP runs beside them.
        every: take every n-th image only.
        frames: take the first so many of them only; 0: all.
        halves: tracks file whose second half is localized in a map of its first; None: left out.
        calibrate: tracks files that say which matches to accept there.
        threads: of every run.
        repeat: the command, as the report tells it.
    """

    sequences: Sequence[Path]
    output: Path
    variants: Sequence[Variant]
    base: Settings
    colmap: bool = True
    every: int = 1
    frames: int = 0
    halves: Path | None = None
    calibrate: Sequence[Path] = ()
    threads: int = 1
    repeat: str = "protomark evaluate-mapping"


def evaluate_mapping(request: Request, json_path: Path | None = None) -> Results:
    """Run every variant on every sequence and write the report.

    Args:
        request: what is asked for.
        json_path: where the figures go too.

    Raises:
        FileNotFoundError, ValueError: a sequence is missing or broken.
        KeyboardInterrupt: what is finished is kept and reported; the same call goes on.
    """
    import cv2

    output = request.output
    if output.exists() and not output.is_dir():
        raise NotADirectoryError(f"{output}: not a folder, name one for the report with -o")
    sequences = open_sequences(request.sequences, request.every, request.frames)
    output.mkdir(parents=True, exist_ok=True)
    kept = Kept(output / KEPT)
    cv2.setNumThreads(request.threads)
    runs: dict[str, dict[str, Run]] = {s.name: {} for s in sequences}
    recalls: list[Recall] = []
    interrupted = False
    with one_blas_thread():
        try:
            recalls = _recalls(request, kept)
            _runs(request, sequences, kept, runs)
        except KeyboardInterrupt:
            interrupted = True
    order = [v.name for v in request.variants] + [COLMAP] * request.colmap
    results = Results(
        sequences=[
            SequenceResult(
                name=s.name,
                frames=len(s.source),
                available=s.available,
                truth=s.truth,
                extent=s.extent,
                poses=s.poses,
                runs={v: runs[s.name][v] for v in order if v in runs[s.name]},
            )
            for s in sequences
        ],
        recalls=recalls,
        localized="" if request.halves is None else _name(request.halves),
        calibrated=[_name(path) for path in request.calibrate],
        missing=[f"{s.name}, {v}" for s in sequences for v in order if v not in runs[s.name]],
        conditions=_conditions(request),
    )
    results = replace(results, targets=targets(results))
    figures.save(results, output)
    text = json.dumps(results.as_dict(), indent=1) + "\n"
    write_text(output / FIGURES, text)
    if json_path is not None:
        write_text(json_path, text)
    write_text(output / REPORT, markdown(results))
    if interrupted:
        raise KeyboardInterrupt
    return results


def _name(path: Path) -> str:
    return path.name.split(".")[0]


@dataclass(frozen=True)
class _Job:
    """One run that is not kept yet."""

    sequence: Images
    name: str
    key: str
    run: Callable[[Callable[[float], None]], Run]


def _runs(
    request: Request, sequences: list[Images], kept: Kept, runs: dict[str, dict[str, Run]]
) -> None:
    """Fill in sequence -> variant -> its run, kept from earlier or made now."""
    jobs = []
    for sequence in sequences:
        for job in _jobs(request, sequence):
            found = _load(kept, job.key)
            if found is None:
                jobs.append(job)
            else:
                runs[sequence.name][job.name] = found
    with progress_bar() as bar:
        task = bar.add_task("mapping", total=sum(len(job.sequence.source) for job in jobs))
        for job in jobs:
            made = job.run(_advancing(bar, task, job))
            kept.save_figures(job.key, asdict(made))
            runs[job.sequence.name][job.name] = made
            progress_console.print(
                f"{job.sequence.name}, {job.name}: {made.registered} of {len(job.sequence.source)} "
                f"frames, {made.wall_seconds:.0f} s",
                highlight=False,
                soft_wrap=True,
            )


def _advancing(bar: Progress, task: TaskID, job: _Job) -> Callable[[float], None]:
    """Shows the share of a job that is done."""
    before = bar.tasks[0].completed
    bar.update(task, description=f"{job.sequence.name}, {job.name}")

    def advance(share: float) -> None:
        bar.update(task, completed=before + round(share * len(job.sequence.source)))

    return advance


def _jobs(request: Request, sequence: Images) -> list[_Job]:
    from protomark.evaluation.mapping import colmap, pipeline
    from protomark.tracks.colmap import pycolmap

    files = [(n, (sequence.source.path / n).stat().st_size) for n in sequence.source.names]
    shared = {
        "sequence": sequence.name,
        "camera": sequence.camera.as_dict(),
        "files": files,
        "threads": request.threads,
    }
    jobs = []
    for variant in request.variants:
        settings = variant.settings(request.base)
        encoder = pm.Encoder.load(settings.encoder or settings.descriptor)

        def mapped(
            advance: Callable[[float], None], name: str = variant.name, s: Settings = settings
        ) -> Run:
            done = 0

            def one_more() -> None:
                nonlocal done
                done += 1
                advance(done / len(sequence.source))

            return pipeline.run(sequence, name, s, request.threads, one_more)

        key = key_of(mapping=_code(), settings=asdict(settings), encoder=encoder.identity, **shared)
        jobs.append(_Job(sequence, variant.name, key, mapped))
    if request.colmap:

        def reconstructed(advance: Callable[[float], None]) -> Run:
            return colmap.run(sequence, request.threads, advance)

        key = key_of(colmap=pycolmap.__version__, exhaustive=colmap.EXHAUSTIVE, **shared)
        jobs.append(_Job(sequence, COLMAP, key, reconstructed))
    return jobs


def _code() -> str:
    """A digest of the pipeline itself: runs of another one are no longer kept ones."""
    from protomark import mapping

    digest = hashlib.sha256(pm.__version__.encode())
    for path in sorted(Path(mapping.__path__[0]).glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _load(kept: Kept, key: str) -> Run | None:
    found = kept.load_figures(key)
    try:
        return None if found is None else Run.from_dict(found)
    except (KeyError, TypeError):
        return None


def _recalls(request: Request, kept: Kept) -> list[Recall]:
    if request.halves is None:
        return []
    from protomark.evaluation.mapping import halves

    key = key_of(
        halves=[(p.name, p.stat().st_size) for p in (request.halves, *request.calibrate)],
        variants=[v.name for v in request.variants],
        encoder=request.base.encoder,
        frames=request.frames,
    )
    found = kept.load_figures(key)
    if found is None:
        recalls = halves.recalls(
            request.halves,
            request.calibrate,
            request.variants,
            request.base.encoder,
            request.frames,
        )
        kept.save_figures(key, {"rows": [vars(r) for r in recalls]})
        return recalls
    return [Recall(**row) for row in found["rows"]]


def _conditions(request: Request) -> dict[str, str]:
    import cv2
    import numpy as np

    from protomark.bench.machine import cpu_model
    from protomark.tracks.colmap import pycolmap

    taken = f"every {request.every}th image" if request.every > 1 else "every image"
    base = request.base
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return {
        "scale": f"{taken}, "
        + (f"the first {request.frames} of them" if request.frames else "to the end"),
        "pipeline": f"{base.descriptor.upper()}, at most {base.max_keypoints} keypoints an image, "
        f"window of {base.window} keyframes; poses unknown, camera known and fixed",
        "COLMAP": f"pycolmap {pycolmap.__version__}, SIFT on the CPU, its default options but "
        "with any distortion, camera known and fixed; of more than 40 images those are matched "
        "that lie up to ten apart or a power of two"
        if request.colmap
        else "left out",
        "time": f"CPU seconds of the process, {request.threads} thread(s); load of the machine at "
        f"the end {load:.1f} on {available_threads()} cores",
        "machine": f"{cpu_model()}, {pm.instruction_set()}, {platform.system()}",
        "versions": f"protomark {pm.__version__}, OpenCV {cv2.__version__}, NumPy "
        f"{np.__version__}, Python {platform.python_version()}",
        "date": time.strftime("%Y-%m-%d"),
        "again": f"`{request.repeat}`",
    }


def print_summary(results: Results, output: Path) -> None:
    """Runs and targets, on stdout."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from protomark.evaluation.mapping.report import run_row

    def table(title: str, *heads: str, words: int = 1) -> Any:
        out = Table(
            title=title,
            title_justify="left",
            box=SIMPLE_HEAD,
            show_edge=False,
            padding=(0, 1, 0, 0),
        )
        for i, head in enumerate(heads):
            out.add_column(head, justify="left" if i < words else "right")
        return out

    for s in results.sequences:
        out = table(
            f"{s.name}, {s.frames} frames",
            *("", "poses", "error", "landmarks", "KB", "ms/frame", "match"),
        )
        for run in s.runs.values():
            row = run_row(s, run)
            out.add_row(*(row[i] for i in (0, 1, 2, 4, 5, 7, 8)))
        console.print(out)
    out = table("Targets", "", "wanted", "", words=2)
    for target in results.targets:
        out.add_row(target.name, target.wanted, mark(target.met))
    console.print(out)
    console.print(f"{output / REPORT}", highlight=False, soft_wrap=True)


def explain_interruption(output: Path) -> None:
    """What to do after Ctrl-C, on stderr."""
    progress_console.print(
        f"stopped; finished runs are kept and reported in {output}, and the same command goes on "
        "after them",
        highlight=False,
        soft_wrap=True,
    )
