"""Runs `protomark bench`: measures sections, and saves results after each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import protomark as pm
from protomark.cli.terminal import note, progress_bar
from protomark_bench import machine
from protomark_bench.report import save_json
from protomark_bench.speed import peers, sections
from protomark_bench.speed.approximate import approximate, real
from protomark_bench.speed.landmarks import RealLandmarks, Workload
from protomark_bench.speed.large import large
from protomark_bench.speed.results import NAME, BenchResults
from protomark_bench.speed.sections import Bench
from protomark_bench.speed.settings import BenchSettings

SECTION_FUNCTIONS: dict[str, Callable[[Bench], None]] = {
    "encode": sections.encode,
    "search": sections.search,
    "hamming": sections.hamming,
    "approximate": approximate,
    "real": real,
    "frame": sections.frame,
    "add": sections.add,
    "growth": sections.growth,
    "large": large,
}


def bench(
    paths: Sequence[Path], settings: BenchSettings, output: Path, repeat: str = "protomark bench"
) -> BenchResults:
    """Measure the sections of the settings; Ctrl-C ends this with the results so far.

    The JSON is written after every section, as a large map may kill the process.

    Args:
        paths: tracks files of one descriptor; if empty, the bundled sample.
        settings: sections and sizes.
        output: folder of the report.
        repeat: the command line that repeats the run, for the report.

    Raises:
        FileNotFoundError, ValueError: a file is missing or broken, or has no encoder.
    """
    landmarks = RealLandmarks.load(paths)
    encoder = pm.Encoder.load(landmarks.descriptor)
    workload = Workload(landmarks, encoder, build_threads=settings.build_threads)
    output.mkdir(parents=True, exist_ok=True)

    def save(results: BenchResults) -> None:
        results.command = repeat
        save_json(output / f"{NAME}.json", results.as_dict())

    results = measure(workload, settings, save)
    save(results)
    return results


def measure(
    workload: Workload,
    settings: BenchSettings,
    after: Callable[[BenchResults], None] = lambda _: None,
) -> BenchResults:
    """Run the sections, and call `after` with the results after each one."""
    real, encoder = workload.real, workload.encoder
    facts = machine.describe(*peers.DISTRIBUTIONS.values())
    facts["threads"] = f"{settings.threads} by default; {settings.build_threads} to build"
    results = BenchResults(machine=facts, skipped=peers.missing())
    results.data = {
        "data": f"{', '.join(real.sequences)}: {len(real):,} landmarks, "
        f"{int(real.counts.sum()):,} observations of {real.descriptor.upper()}",
        "synthetic landmarks": "crossed byte by byte from a real landmark and one of its nearest; "
        "observations from their real observations, queries from held-out ones",
        "encoder": f"{encoder.name}, {workload.dim} dimensions",
    }
    for reason in results.skipped:
        note(reason)
    total = len(settings.sections)
    with progress_bar() as progress, peers.threads(settings.threads):
        progress("ceilings", 0, total)
        try:
            results.ceilings = machine.ceilings(settings.pace.shortest * 4)
            if {"approximate", "real"} & set(settings.sections):
                progress("resemblance of the data", 0, total)
                results.resemblance = sections.measure_resemblance(workload)
            for done, name in enumerate(settings.sections):

                def advance(label: str, name: str = name, done: int = done) -> None:
                    progress(f"{name}, {label}", done, total)

                SECTION_FUNCTIONS[name](Bench(workload, settings, results, advance))
                results.interrupted = (
                    name != settings.sections[-1]
                )  # true if the process is killed now
                after(results)
        except KeyboardInterrupt:
            results.interrupted = True
    return results
