"""`protomark evaluate-mapping`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import listed


def evaluate_mapping(
    sequences: Annotated[
        list[Path],
        typer.Argument(
            metavar="SEQUENCES",
            help="Folders that hold images/ and, with the camera and the true poses, a COLMAP "
            "model in sparse/.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for the report and all that is kept."),
    ] = Path("mapping-evaluation"),
    variants: Annotated[
        str,
        typer.Option(
            help="What maps keep of descriptors, of traditional (all of them), medoid, "
            "prototypes-32 and prototypes-16, with commas between; by default all."
        ),
    ] = "",
    colmap: Annotated[
        bool, typer.Option(help="Also COLMAP's own incremental reconstruction with SIFT.")
    ] = True,
    every: Annotated[int, typer.Option(min=1, help="Take every n-th image only.")] = 1,
    frames: Annotated[
        int, typer.Option(min=0, help="Take the first so many of those only, 0 for all.")
    ] = 0,
    halves: Annotated[
        Path | None,
        typer.Option(
            help="Tracks file, its poses in metres: also localize its second half in a map of its "
            "first half (--frames frames of it at most)."
        ),
    ] = None,
    calibrate: Annotated[
        list[Path] | None,
        typer.Option(
            help="Tracks file of another sequence, to learn there which matches are right, for "
            "--halves; may be repeated."
        ),
    ] = None,
    descriptor: Annotated[
        str,
        typer.Option(
            "--descriptor", "-d", help="As `protomark map` takes them; the paper's is freak."
        ),
    ] = "akaze",
    encoder: Annotated[
        str, typer.Option(help="Name or file of the encoder; by default the descriptor's own.")
    ] = "",
    max_keypoints: Annotated[
        int, typer.Option(help="Keypoints kept in a frame, strongest first, spread over it.")
    ] = 2000,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of every run.")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file too.")
    ] = None,
) -> None:
    """Map sequences with all descriptors, medoids and prototypes, and compare, with COLMAP too.

    Frames registered, trajectory error against the true poses, landmarks, time and descriptor
    bytes, all variants in the same code, poses unknown and the camera known. OUTPUT gets report.md
    with its plots and report.json. Finished runs are kept and reported: after Ctrl-C the same
    command goes on. A short run: --frames 60 --no-colmap.
    """
    from protomark.evaluation.command import check_outputs
    from protomark.evaluation.mapping import command
    from protomark.evaluation.mapping.variants import choose
    from protomark.mapping.settings import Settings

    check_outputs(json_file)
    if halves is not None and not calibrate:
        raise ValueError("--halves needs tracks of another sequence, give them with --calibrate")
    flags = [f"--variants {variants}"] if variants else []
    flags += [] if colmap else ["--no-colmap"]
    flags += [f"--every {every}"] if every > 1 else []
    flags += [f"--frames {frames}"] if frames else []
    flags += [f"--halves {halves.name}"] if halves is not None else []
    flags += [f"--calibrate {path.name}" for path in calibrate or []]
    flags += [f"-d {descriptor}"] if descriptor != "akaze" else []
    flags += [f"--encoder {Path(encoder).name}"] if encoder else []
    flags += [f"--max-keypoints {max_keypoints}"] if max_keypoints != 2000 else []
    flags += [f"--threads {threads}"] if threads != 1 else []
    names = [path.resolve().name for path in sequences]
    request = command.Request(
        sequences=sequences,
        output=output,
        variants=choose(list(listed(variants))),
        base=Settings(descriptor=descriptor, encoder=encoder, max_keypoints=max_keypoints),
        colmap=colmap,
        every=every,
        frames=frames,
        halves=halves,
        calibrate=calibrate or [],
        threads=threads,
        repeat=" ".join(["protomark evaluate-mapping", *names, *flags]),
    )
    try:
        results = command.evaluate_mapping(request, json_file)
    except KeyboardInterrupt:
        command.explain_interruption(output)
        raise typer.Exit(130) from None
    command.print_summary(results, output)
