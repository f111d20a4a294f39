"""The commands that this distribution adds to `protomark`; imports nothing heavy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def bench(
    tracks: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="TRACKS",
            help="Tracks files of one descriptor to take landmarks from; by default the sample.",
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the report, its plots and JSON.")
    ] = Path("benchmarks-report"),
    only: Annotated[
        str,
        typer.Option(
            help="Sections to measure, for example encode,search: encode, search, hamming, "
            "approximate, real, frame, add, growth and large. By default all."
        ),
    ] = "",
    scale: Annotated[
        str,
        typer.Option(
            help="quick: tiny sizes, as a test; usual: a quarter of an hour; full: also 10 and 100 "
            "million landmarks, which takes hours and much memory."
        ),
    ] = "usual",
    landmarks: Annotated[
        str,
        typer.Option(
            help="Sizes of the maps in place of the scale's, for example 10000,1000000. The "
            "sections frame, add and large take the largest."
        ),
    ] = "",
    graphs: Annotated[
        str,
        typer.Option(
            help="Graphs to measure, which take long to build: all, none, or names of faiss, "
            "faiss-lists (65,536 inverted lists that a graph finds, beyond a million landmarks), "
            "hnswlib, usearch-int8 and usearch-float32. Named graphs, and all with --landmarks, "
            "are measured at any size; otherwise only hnswlib beyond 100,000 landmarks (--scale "
            "full: a million)."
        ),
    ] = "all",
    indexes: Annotated[
        Path | None,
        typer.Option(help="Folder that caches graphs for later runs on the same data."),
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of every contender.")] = 1,
    source: Annotated[
        Path | None,
        typer.Option("--from", help="Only write the report of the JSON of an earlier run."),
    ] = None,
) -> None:
    """Measure speed beside PyTorch, ONNX Runtime, FAISS, OpenCV, hnswlib and USearch.

    All contenders take turns in one run, on the same data and the same number of threads. The
    report has ratios with their spread, and the machine's ceilings. Peers that are not installed
    are left out. Ctrl-C ends the run and reports what is measured by then. Temporary maps are
    written to TMPDIR.

    protomark bench --scale quick
    """
    from protomark.cli.terminal import comma_separated, comma_separated_numbers
    from protomark.files import check_folder
    from protomark.threads import available_threads
    from protomark_bench.options import command_line
    from protomark_bench.speed import command
    from protomark_bench.speed.results import BenchResults
    from protomark_bench.speed.settings import settings_of

    check_folder(output)
    if source is not None:
        results = BenchResults.load(source)
    else:
        settings = settings_of(
            scale,
            comma_separated(only),
            threads,
            build_threads=available_threads(),
            indexes=indexes,
        )
        settings = settings.at(comma_separated_numbers("--landmarks", landmarks)).with_graphs(
            graphs
        )
        again = command_line(
            "bench",
            tracks,
            only=only,
            scale=(scale, "usual"),
            landmarks=landmarks,
            graphs=(graphs, "all"),
            indexes=indexes,
            threads=(threads, 1),
        )
        results = command.bench(tracks or [], settings, output, again)
    results.report().publish(output)
    if results.interrupted and source is None:
        raise typer.Exit(130)


def reproduce(
    data: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="TRACKS",
            help="Tracks files, or folders of them, as `protomark tracks` makes them.",
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for the report and the cache."),
    ] = Path("reproduction"),
    scale: Annotated[
        str,
        typer.Option(
            help="small: minutes, on the smaller sequences; medium: short trainings on all "
            "sequences; full: trainings until the validation loss stagnates, which take hours."
        ),
    ] = "small",
    descriptor: Annotated[
        str, typer.Option("--descriptor", "-d", help="Descriptor; the paper's is freak.")
    ] = "freak",
    train: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Sequence to train on; may be repeated."),
    ] = None,
    validation: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Sequence to select networks on; may be repeated."),
    ] = None,
    test: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Sequence to measure on; may be repeated."),
    ] = None,
    jobs: Annotated[
        int, typer.Option(min=0, help="Trainings at a time; 0 for as many as fit the cores.")
    ] = 0,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of one training.")] = 1,
    source: Annotated[
        Path | None,
        typer.Option("--from", help="Only write the report of the JSON of an earlier run."),
    ] = None,
) -> None:
    """Run the paper's evaluation again, and report it beside the paper's numbers.

    Trains 'fat' and 'funnel' networks of 2 to 5 layers as triplet and as prototypical networks,
    compares prototypes of 8 to 64 dimensions and the other methods of the paper's table, and
    writes a report with figures (needs PyTorch). Finished trainings are cached: after Ctrl-C the
    same command continues. Sequences with other names than the project's need --train,
    --validation and --test.

    protomark reproduce tracks/ --scale small
    """
    from protomark.extras import optional
    from protomark.files import check_folder
    from protomark.threads import available_threads
    from protomark_bench.options import resumable
    from protomark_bench.paper.results import PaperResults

    check_folder(output)
    if source is not None:
        results = PaperResults.load(source)
    else:
        if not data:
            raise ValueError("name tracks files, or the JSON of an earlier run with --from")
        optional("torch")
        from protomark_bench.paper import command
        from protomark_bench.paper.scale import find_scale

        settings = command.PaperSettings(
            scale=find_scale(scale),
            descriptor=descriptor,
            jobs=jobs or max(available_threads() // threads, 1),
            threads=threads,
            roles={"training": train or [], "validation": validation or [], "test": test or []},
        )
        with resumable(output):
            results = command.reproduce(data, output, settings)
    results.report().publish(output)


def evaluate_mapping(
    sequences: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="SEQUENCES",
            help="Folders that hold images/ and, with the camera and the true poses, a COLMAP "
            "model in sparse/.",
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for the report and the cache."),
    ] = Path("mapping-evaluation"),
    memories: Annotated[
        str,
        typer.Option(
            help="What maps keep of descriptors, for example traditional,medoid: traditional "
            "(all descriptors), medoid, prototypes-32 and prototypes-16. By default all."
        ),
    ] = "",
    colmap: Annotated[
        bool, typer.Option(help="Also run COLMAP's incremental reconstruction with SIFT.")
    ] = True,
    every: Annotated[int, typer.Option(min=1, help="Take every n-th image only.")] = 1,
    frames: Annotated[
        int, typer.Option(min=0, help="Take only so many of these images; 0 for all.")
    ] = 0,
    descriptor: Annotated[
        str,
        typer.Option(
            "--descriptor", "-d", help="Descriptor of `protomark map`; the paper's is freak."
        ),
    ] = "akaze",
    encoder: Annotated[
        str,
        typer.Option(help="Name or file of the encoder; by default the one for the descriptor."),
    ] = "",
    max_keypoints: Annotated[
        int, typer.Option(help="Limit on keypoints per image, the strongest, spread over it.")
    ] = 2000,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of every run.")] = 1,
    source: Annotated[
        Path | None,
        typer.Option("--from", help="Only write the report of the JSON of an earlier run."),
    ] = None,
) -> None:
    """Compare mapping with all descriptors, medoids and prototypes, and with COLMAP.

    Reports registered frames, trajectory errors, landmarks, time and descriptor bytes. All memories
    run in the same code, with unknown poses and a known camera. Finished runs are cached and
    reported: after Ctrl-C the same command continues.

    protomark evaluate-mapping kitchen/ --frames 60 --no-colmap
    """
    from protomark.files import check_folder
    from protomark_bench.mapping.results import MappingResults
    from protomark_bench.options import command_line, resumable

    check_folder(output)
    if source is not None:
        results = MappingResults.load(source)
    else:
        if not sequences:
            raise ValueError("name folders of sequences, or the JSON of an earlier run with --from")
        from protomark_bench.mapping import command

        again = command_line(
            "evaluate-mapping",
            sequences,
            memories=memories,
            colmap=(colmap, True),
            every=(every, 1),
            frames=(frames, 0),
            descriptor=(descriptor, "akaze"),
            encoder=Path(encoder).name,
            max_keypoints=(max_keypoints, 2000),
            threads=(threads, 1),
        )
        request = command.MappingRequest(
            sequences=sequences,
            output=output,
            memories=command.choose_memories(memories),
            descriptor=descriptor,
            encoder=encoder,
            max_keypoints=max_keypoints,
            colmap=colmap,
            every=every,
            frames=frames,
            threads=threads,
            command=again,
        )
        with resumable(output):
            results = command.evaluate_mapping(request)
    results.report().publish(output)
