"""The command `protomark merge`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from protomark.cli.options import JsonFile, NoSeal, Threads


def merge(
    maps: Annotated[
        list[Path],
        typer.Argument(
            metavar="MAP",
            help="Learning maps of the same encoder, dimensions and appearance bits, or folders "
            "of `protomark map`.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="Map file to write (.pmk), or new folder for folders' maps."
        ),
    ],
    renumber: Annotated[
        bool,
        typer.Option(
            "--renumber",
            help="The maps have no landmark in common, whatever the ids say: landmarks of each "
            "further map get new ids above all earlier ones. Positions must be of one world.",
        ),
    ] = False,
    align: Annotated[
        bool,
        typer.Option("--align", help="Each map has a world of its own, whatever the ids say."),
    ] = False,
    fixed_scale: Annotated[
        bool, typer.Option("--fixed-scale", help="The maps have one scale, such as metres.")
    ] = False,
    draw: Annotated[
        Path | None,
        typer.Option(
            help="Draw the maps and what joins them from above (.png, .svg, .pdf).",
        ),
    ] = None,
    no_seal: NoSeal = False,
    threads: Threads = 0,
    json_file: JsonFile = None,
) -> None:
    """Merge maps that were built apart.

    Maps that agree on what each id is are summed exactly: the map that would have been built from
    all their observations together. Maps that number landmarks each on its own are recognized by
    their prototypes and moved into the world of the first, in which duplicates become one
    landmark; places that only look alike are refused.

    Folders are merged with poses, cameras and observations, adjusted together; `map --into`
    extends the result. A map file has landmarks only.

    protomark merge monday.pmk tuesday.pmk -o week.pmk

    protomark merge kitchen/ hall/ -o flat/
    """
    from protomark.cli.terminal import (
        note,
        note_outdated,
        note_replaced,
        print_facts,
        progress_bar,
        write_json,
    )
    from protomark.extras import optional
    from protomark.files import SCENE_MAP, check_outputs
    from protomark.maps.merge import merge_files
    from protomark.plot import check_suffix

    to_folder = output.suffix != ".pmk"
    if draw is not None:
        check_suffix(draw)
        optional("matplotlib")
    if not to_folder and no_seal:
        raise ValueError("--no-seal is for folders: a merged map file has no sealed one beside it")
    if to_folder:
        if renumber:
            raise ValueError("--renumber is for map files: name one to write, such as merged.pmk")
        check_outputs(draw, json_file, inputs=maps, folder=output)
    else:
        files = [path / SCENE_MAP for path in maps]
        check_outputs(draw, json_file, inputs=[*maps, *files], maps=[output])
        note_replaced(output)
    with progress_bar() as progress:
        if to_folder:
            from protomark.mapping.merging_maps import merge_folders

            merged = merge_folders(
                maps,
                output,
                align=align,
                fixed_scale=fixed_scale,
                seal=not no_seal,
                threads=threads,
                progress=progress,
            )
        else:
            merged = merge_files(
                maps,
                output,
                renumber=renumber,
                align=align,
                fixed_scale=fixed_scale,
                threads=threads,
                progress=progress,
            )
    facts = merged.facts
    write_json(json_file, facts)
    if draw is not None:
        from protomark.plot import merge_figure, save_figure

        save_figure(merge_figure(merged.landmarks, merged.common), draw, made_by="protomark merge")
    rows = []
    for i, one in enumerate(facts["inputs"]):
        shared = f", {one['in_common']:,} of them in an earlier map" if i else ""
        file = Path(one["file"])
        name = f"{file.parent.name}/{file.name}" if file.name == SCENE_MAP else file.name
        rows.append((name, f"{one['landmarks']:,} landmarks{shared}"))
        if one["moved"]:
            rows.append(("", _moved(one["moved"])))
    rows.append(("merged", f"{facts['landmarks']:,} landmarks, {facts['bytes']:,} bytes"))
    if not to_folder and any(path.is_dir() for path in maps):
        rows.append(
            ("left out", "frames and their poses: name a folder with -o to merge them, too")
        )
    print_facts(rows)
    if not to_folder:
        note_outdated(output)
    for warning in facts.get("warnings", []):
        note(f"cannot be trusted: {warning}")
    if facts.get("warnings"):
        raise typer.Exit(1)


def _moved(facts: dict[str, Any]) -> str:
    """What says how a map lies in the world of the first."""
    return (
        f"moved by {facts['degrees']:.1f} degrees, scaled by {facts['scale']:.4g}: "
        f"{facts['agreeing']:,} of {facts['likely']:,} likely pairs agree (by chance: 1 in "
        f"10^{-facts['log10_chance']:.0f} maps), in {facts['cube_share']:.0%} of the space that "
        "both show"
    )
