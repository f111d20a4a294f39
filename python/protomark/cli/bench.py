"""`protomark bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import listed, numbers


def bench(
    tracks: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="TRACKS",
            help="Tracks files of one descriptor, to grow data from; by default the sample.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder for the report: benchmarks.md and its plots."),
    ] = None,
    only: Annotated[
        str,
        typer.Option(
            help="Sections, for example encode,search; of encode, search, hamming, approximate, "
            "real, frame, add, growth and large. By default all."
        ),
    ] = "",
    full: Annotated[
        bool,
        typer.Option("--full", help="Also 10 and 100 million landmarks: hours, and much memory."),
    ] = False,
    quick: Annotated[
        bool, typer.Option("--quick", help="Tiny sizes: whether it runs, not how fast.")
    ] = False,
    landmarks: Annotated[
        str,
        typer.Option(
            help="Sizes of the maps that are searched (search, hamming, approximate, growth; of "
            "large the last one), for example 10000,1000000, in place of the usual ones."
        ),
    ] = "",
    graphs: Annotated[
        str,
        typer.Option(
            help="Which graphs are raced, as they take long to build: all, none, or some of faiss, "
            "faiss-cells (65,536 inverted lists that a graph finds, beyond a million landmarks), "
            "hnswlib, usearch-int8 and usearch-float32. Those that are named, and all with "
            "--landmarks, are raced at any size; else up to 100,000 (--full: a million) landmarks, "
            "and hnswlib's beyond."
        ),
    ] = "all",
    indexes: Annotated[
        Path | None,
        typer.Option(
            help="Folder where graphs are kept, and found by later runs on the same data."
        ),
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of every contender.")] = 1,
    scratch: Annotated[
        Path | None,
        typer.Option(help="Folder for maps that are thrown away; the system's by default."),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    r"""Measure speed beside PyTorch, ONNX Runtime, FAISS, OpenCV, hnswlib and USearch.

    All contenders take turns in one run, on the same data and as many threads; ratios come with
    their spread, and beside the machine's own ceilings. Peers that are not installed are left out:
    `pip install protomark\[bench]`. Ctrl-C ends the run and keeps what is measured; `--json` is
    written anew after every section.
    docs/benchmarks.md holds a whole run.
    """
    import tempfile

    from protomark.bench import command
    from protomark.bench.settings import choose
    from protomark.evaluation.command import check_outputs
    from protomark.evaluation.threads import available_threads

    check_outputs(json_file)
    settings = choose(
        sections=listed(only),
        threads=threads,
        build_threads=available_threads(),
        full=full,
        quick=quick,
        scratch=scratch or Path(tempfile.gettempdir()),
        landmarks=numbers("--landmarks", landmarks),
        graphs=None if graphs == "all" else () if graphs == "none" else listed(graphs),
        indexes=indexes,
    )
    flags = [f"--only {only}"] if only else []
    flags += [f"--landmarks {landmarks}"] if landmarks else []
    flags += [f"--graphs {graphs}"] if graphs != "all" else []
    flags += [f"--indexes {indexes.name}"] if indexes is not None else []
    flags += ["--full"] if full else ["--quick"] if quick else []
    flags += [f"--threads {threads}"] if threads != 1 else []
    repeat = " ".join(["protomark bench", *(path.name for path in tracks or []), *flags])
    results = command.bench(tracks or [], settings, output, json_file, repeat)
    command.print_summary(results, output)
    if results.interrupted:
        raise typer.Exit(130)
