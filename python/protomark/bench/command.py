"""`protomark bench`: tracks in; tables, JSON and plots out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import protomark as pm
from protomark.bench import figures, machine, peers, report
from protomark.bench.progress import Bar, bar
from protomark.bench.real import Observations
from protomark.bench.results import Results
from protomark.bench.sections import (
    add,
    approximate,
    encode,
    frame,
    growth,
    hamming,
    large,
    resemblance,
    search,
)
from protomark.bench.settings import Settings
from protomark.bench.workload import Workload
from protomark.console import console, progress_console
from protomark.files import write_text

Section = Callable[[Workload, Results, Bar], None]
_RUN: dict[str, Section] = {
    "encode": encode.run,
    "search": search.run,
    "hamming": hamming.run,
    "approximate": approximate.run,
    "real": approximate.run_real,
    "frame": frame.run,
    "add": add.run,
    "growth": growth.run,
    "large": large.run,
}
# Seconds on two cores of a server of 2023, for the bar's time left; at a million landmarks.
_COSTS = {
    "encode": 30.0,
    "search": 60.0,
    "hamming": 150.0,
    "approximate": 500.0,
    "real": 200.0,
    "frame": 10.0,
    "add": 10.0,
    "growth": 60.0,
    "large": 20.0,
}


def bench(
    paths: Sequence[Path],
    settings: Settings,
    folder: Path | None = None,
    json_path: Path | None = None,
    repeat: str = "protomark bench",
) -> Results:
    """Measure, and write what was asked for; after Ctrl-C, what there is by then.

    The figures are written after every section: a large map may end the process.

    Args:
        paths: tracks files of one descriptor; none: the sample that ships.
        settings: sections and sizes.
        folder: for benchmarks.md and its plots.
        json_path: for the figures.
        repeat: the command line that does the same again, for the report.

    Raises:
        FileNotFoundError, ValueError: a file is missing or broken, or no encoder ships for it.
    """
    real = Observations.load(paths)
    encoder = pm.Encoder.load(real.descriptor)

    def save(so_far: Results) -> None:
        so_far.command = repeat
        if json_path is not None:
            so_far.save(json_path)

    results = measure(Workload(real, encoder, settings), save)
    save(results)
    if folder is not None:
        write_report(results, folder)
    return results


def measure(workload: Workload, after: Callable[[Results], None] = lambda _: None) -> Results:
    """Run the sections that the settings name, and call `after` each with what there is by then."""
    settings = workload.settings
    results = Results(machine=machine.describe(), data=describe_data(workload))
    results.machine |= {
        peers.NAMES[module]: found
        for module, found in machine.versions(peers.DISTRIBUTIONS).items()
    }
    results.machine["threads"] = (
        f"{settings.threads} where not said otherwise; {settings.build_threads} to build"
    )
    results.skipped += peers.missing()
    for note in results.skipped:
        progress_console.print(f"note: {note}", highlight=False, soft_wrap=True, markup=False)
    costs = {name: _COSTS[name] * _scale(name, settings) for name in settings.sections}
    with bar({"ceilings": 3.0, **costs}) as progress, peers.threads(settings.threads):
        try:
            progress.begin("ceilings", 1)
            progress.advance("of this machine")
            machine.measure_ceilings(results, settings.pace.shortest * 4)
            if {"approximate", "real"} & set(settings.sections):
                progress.advance("grown data beside real data")
                resemblance.measure(workload, results)
            progress.end()
            for name in settings.sections:
                _RUN[name](workload, results, progress)
                progress.end()
                results.interrupted = name != settings.sections[-1]  # for whoever ends it now
                after(results)
        except KeyboardInterrupt:
            results.interrupted = True
    return results


def describe_data(workload: Workload) -> dict[str, str]:
    """What was measured on, and how it was made."""
    real = workload.real
    return {
        "data": f"{', '.join(real.sequences)}: {len(real):,} landmarks, "
        f"{int(real.counts.sum()):,} observations of {real.descriptor.upper()}",
        "grown from it": "landmarks crossed byte by byte from a real one and one of those nearest "
        "to it, observations from their real observations, queries from observations kept out",
        "encoder": f"{workload.encoder.name}, {workload.settings.dim} dimensions",
    }


def write_report(results: Results, folder: Path) -> Path:
    """benchmarks.md and its plots in `folder`; the path of the document."""
    folder.mkdir(parents=True, exist_ok=True)
    names = figures.save(results, folder)
    path = folder / "benchmarks.md"
    write_text(path, report.markdown(results, names))
    return path


def print_summary(results: Results, folder: Path | None) -> None:
    """The table of targets, and what was left out."""
    console.print(report.rich_table(results))
    for line in report.ceilings(results):
        console.print(f"ceiling of one thread, {line}", highlight=False)
    for note in results.skipped:
        console.print(f"left out: {note}", highlight=False, soft_wrap=True, markup=False)
    if results.interrupted:
        console.print("interrupted: only what was measured by then", style="bold")
    if folder is not None:
        console.print(f"report: {folder / 'benchmarks.md'}", highlight=False, soft_wrap=True)


def _scale(section: str, settings: Settings) -> float:
    """How much longer than at a million landmarks a section takes, about."""
    sizes = {
        "search": settings.exact,
        "hamming": settings.exact,
        "approximate": settings.approximate,
        "growth": settings.growth,
        "large": (settings.large,),
    }.get(section, (settings.map,))
    return max(math.fsum(sizes) / 1e6, 0.01)
