"""The command `protomark info`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from protomark.cli.options import JsonFile

_BARS = "▁▂▃▄▅▆▇█"


def info(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A map or its folder, an encoder or tracks.")
    ],
    verify: Annotated[
        bool,
        typer.Option(
            "--verify", help="Check every checksum of a map or an encoder; tracks have none."
        ),
    ] = False,
    json_file: JsonFile = None,
) -> None:
    """Describe what a file holds; --json has all, such as what its bytes are spent on.

    protomark info kitchen/scene.pmk --verify
    """
    from protomark import ShardedMap, verify_file
    from protomark.cli.terminal import error_console, write_json
    from protomark.files import check_outputs
    from protomark.maps.info import describe, is_tracks
    from protomark.maps.open import map_path
    from protomark.maps.shards import is_sharded

    check_outputs(json_file, inputs=[file])
    with error_console.status(f"Reading {file.name}"):
        facts = describe(file)
        if verify and is_tracks(file):
            facts["checksums"] = "none in a tracks file, which is checked whole whenever it is read"
        elif verify:
            if is_sharded(file):
                ShardedMap(file).verify()
            else:
                verify_file(map_path(file))
            facts["checksums"] = "all right"
    write_json(json_file, facts)
    show(facts)


def show(facts: dict[str, Any]) -> None:
    """Print the most important of what `protomark.maps.info.describe` returned."""
    from protomark.cli.terminal import print_facts

    known = {"tracks": _track_rows, "encoder": _encoder_rows, "map in shards": _shard_rows}
    rows = known.get(facts["kind"], _map_rows)
    checked = [("checksums", facts["checksums"])] if "checksums" in facts else []
    # A text of a stranger's file must not pass for another row.
    lines = [
        ("; ".join(name.splitlines()), "; ".join(text.splitlines())) for name, text in rows(facts)
    ]
    print_facts([("kind", facts["kind"]), *lines, *checked])


def _map_rows(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    landmarks, encoder = facts["landmarks"], facts["encoder"]
    several = facts["prototypes_per_landmark"]
    each = f"{several:.2f} prototypes" if several else "a prototype"
    yield "landmarks", f"{landmarks:,}, each with {each} of {facts['dim']} numbers"
    if facts["observations"] is not None:
        bars = _bars(facts["count_histogram"] or [])
        yield "observations", f"{facts['observations']:,}; per landmark 1 {bars} 16 and more"
    sections = facts["bytes_by_section"]
    each = (facts["bytes"] - sections["encoder"]) / max(landmarks, 1)
    yield (
        "bytes",
        f"{facts['bytes']:,}: {sections['encoder']:,} for the encoder, {each:,.1f} per landmark",
    )
    yield "encoder", f"{encoder['name']}, for {encoder['descriptor']} of {_length(encoder)}"
    lists = facts["nlist"]
    yield "index", f"{lists:,} inverted lists" if lists else "none: every search is exact"
    posed = facts["landmarks_with_position"]
    where = f"of {posed:,} landmarks" if posed else "none: images cannot be localized in it"
    if facts["position_error"]:
        where += f", exact to {max(facts['position_error']):.2g}"
    yield "positions", where
    if facts["extent"]:
        yield "extent", " to ".join(_vector(corner) for corner in facts["extent"])
    yield from _metadata_rows(facts["metadata"])
    if facts["journal"]:
        yield "journal", f"{facts['journal']['commits']:,} commits since the file was written"
    if sealed := facts.get("sealed"):
        yield "sealed map", f"{sealed['file']}, {sealed['bytes']:,} bytes"


def _shard_rows(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    landmarks = facts["landmarks"]
    each = facts["prototypes"] / landmarks
    yield "landmarks", f"{landmarks:,}, each with {each:.2f} prototypes of {facts['dim']} numbers"
    if facts["observations"] is not None:
        yield "observations", f"{facts['observations']:,}"
    yield "shards", f"{facts['shards']:,}, the largest of {facts['largest_shard']:,} bytes"
    yield "bytes", f"{facts['bytes']:,} in all files"
    yield "encoder", f"{facts['encoder']['name']}, for {facts['encoder']['descriptor']}"
    yield "positions", f"of {facts['landmarks_with_position']:,} landmarks"
    yield from _metadata_rows(facts["metadata"])
    if run := facts.get("run"):
        yield (
            "this run",
            f"{run['observations']:,} observations in {run['seconds']:.1f} s, "
            f"{run['observations_per_worker_second']:,.0f} per second of a worker; "
            f"{run['bytes_moved'] / 1e6:,.1f} MB moved, {run['retries']} retries; "
            f"{run['shards_written']} shards written, {run['shards_taken_over']} taken over",
        )


def _metadata_rows(metadata: dict[str, str]) -> Iterator[tuple[str, str]]:
    from protomark.maps.origin import SOURCES, source_rows

    yield from source_rows(metadata)
    for name, text in metadata.items():
        if name != SOURCES:
            yield f"metadata: {name}", text


def _length(facts: dict[str, Any]) -> str:
    """Length of the descriptors of an encoder or of tracks."""
    bits: int = facts["bits"]
    return f"{bits} bits" if facts["input"] == "bits" else f"{bits // 8} bytes"


def _encoder_rows(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield "name", facts["name"]
    yield "descriptor", f"{facts['descriptor']}, {_length(facts)}"
    yield "numbers", f"{', '.join(map(str, facts['dims']))} per prototype"
    yield "trained on", facts["data"]
    yield "licence", facts["licence"]
    yield "bytes", f"{facts['bytes']:,}"


def _track_rows(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    from protomark.report import track_rows

    yield "descriptor", f"{facts['descriptor']}, {_length(facts)}"
    yield "keypoints", f"{facts['keypoints']:,} in {facts['keyframes']:,} keyframes"
    yield from track_rows(facts)
    yield "bytes", f"{facts['bytes']:,}"


def _bars(histogram: list[int]) -> str:
    """Numbers of landmarks with 1, 2, ..., 16 and more observations, as one line of bars."""
    bins = [*histogram[1:16], sum(histogram[16:])]
    top = max(max(bins), 1)
    return "".join(_BARS[int(v / top * (len(_BARS) - 1))] if v else " " for v in bins)


def _vector(values: list[float]) -> str:
    return f"({', '.join(f'{v:,.6g}' for v in values)})"
