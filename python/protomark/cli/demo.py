"""The command `protomark demo`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protomark.cli.options import EncoderName, JsonFile

if TYPE_CHECKING:
    from protomark.evaluation.demo import DemoResult


def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the maps and the picture.")
    ] = Path("demo"),
    encoder: EncoderName = None,
    tracks: Annotated[Path | None, typer.Option(help="Tracks in place of the sample.")] = None,
    json_file: JsonFile = None,
) -> None:
    """Map the bundled sample, localize frames in it, and compare.

    Writes a learning map, a sealed map and a picture, and prints how precise Protomark and other
    ways to keep descriptors are. Takes about half a minute and needs no data.

    protomark demo
    """
    from protomark.cli.terminal import progress_bar, write_json
    from protomark.evaluation.demo import run_demo
    from protomark.files import check_outputs

    check_outputs(json_file, folder=output)
    with progress_bar() as progress:
        result = run_demo(output, tracks_path=tracks, encoder=encoder, progress=progress)
    table = [asdict(row) for row in result.comparison.rows()]
    write_json(json_file, {**asdict(result), "table": table})
    _show(result)


def _show(result: DemoResult) -> None:
    from protomark.cli.evaluate import results_table
    from protomark.cli.terminal import console, readable_size, say
    from protomark.evaluation.results import caption

    methods = result.comparison.rows()
    console.print(results_table(caption(result.comparison), methods))
    folder = Path(result.folder)
    files = [f"{folder / name} ({readable_size(size)})" for name, size in result.files.items()]
    text = f"Wrote {', '.join(files)} in {result.seconds:.0f} s."
    console.print(text, markup=False, highlight=False, soft_wrap=True)
    rows = {row.name: row for row in methods}
    raw, ours = rows["unaggregated"], rows[result.shown]
    say(
        f"[bold]What it means:[/] {ours.bytes_per_landmark:.0f} bytes per landmark in place of "
        f"{raw.bytes_per_landmark:.0f} keep {100 * ours.precision / raw.precision:.0f} % of the "
        f"precision; in the sealed map the encoder adds {readable_size(result.encoder_bytes)}, "
        "however large the map gets."
    )
    say(
        "[bold]What next:[/] `protomark map photos/ -o scene` maps your own images, `protomark "
        "localize scene new/` finds others in the map, and `protomark --help` lists the rest."
    )
