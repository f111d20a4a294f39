"""The manifest of a folder whose maps, its shards, are one map."""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import protomark as pm
from protomark.files import MANIFEST, write_text

FORMAT, VERSION = "protomark-shards", 1
# Header of a container: magic, version, kind, size, number of sections (docs/format.md).
_HEADER = struct.Struct("<8sIIQI")


@dataclass(frozen=True)
class ShardFile:
    """A map file of a shard."""

    name: str  # in the folder of the manifest
    bytes: int
    identity: str  # SHA-256 of its header and section table, which hold all checksums
    nlist: int = 0  # inverted lists of its index; 0: it has none


@dataclass(frozen=True)
class Shard:
    """A part of a map: its landmarks, and the files that hold them."""

    name: str
    landmarks: int
    prototypes: int
    observations: int | None  # None: nobody counted them
    ids: tuple[int, int]  # the smallest and the largest
    placed: int  # landmarks with a position
    box: tuple[tuple[float, ...], tuple[float, ...]] | None  # lowest and highest coordinates
    learning: ShardFile | None = None
    sealed: ShardFile | None = None

    @property
    def answering(self) -> ShardFile:
        """The file to search: the sealed one if there is one."""
        file = self.sealed or self.learning
        assert file is not None
        return file

    @property
    def files(self) -> list[ShardFile]:
        """All files."""
        return [file for file in (self.learning, self.sealed) if file is not None]


@dataclass(frozen=True)
class Manifest:
    """What a folder of shards holds."""

    encoder: Mapping[str, str]  # name, identity, descriptor
    dim: int
    appearance_bits: int | None  # None: only sealed maps are left, which do not say
    metadata: Mapping[str, str]
    shards: Sequence[Shard]
    build: Mapping[str, Any] = field(default_factory=dict)  # how it was built

    def save(self, folder: Path) -> None:
        """Write the manifest, which makes the shards it names the content of the folder.

        Raises:
            ValueError: it would replace another file.
        """
        check_manifest(folder)
        write_text(folder / MANIFEST, self.text())

    def text(self) -> str:
        """The manifest as JSON."""
        facts = {"format": FORMAT, "version": VERSION, **asdict(self)}
        return json.dumps(facts, indent=1) + "\n"

    @classmethod
    def load(cls, folder: Path) -> Manifest:
        """Read the manifest of a folder.

        Raises:
            FileNotFoundError: there is none.
            ValueError: it is broken, or of a later version.
        """
        path = folder / MANIFEST
        if not path.is_file():
            raise FileNotFoundError(
                f"{folder} holds no {MANIFEST}, which `protomark split` and `protomark build --ray`"
                " write: name a folder of shards, or a map file"
            )
        try:
            return cls.parse(path.read_bytes())
        except ValueError as error:
            raise pm.FileError(f"{path}: {error}") from None

    @classmethod
    def parse(cls, text: str | bytes) -> Manifest:
        """Read and check the text of a manifest; raises ValueError."""
        try:
            facts = json.loads(text)
            if facts["format"] != FORMAT:
                raise ValueError("JSON, but no manifest of shards")
            if facts["version"] != VERSION:
                raise ValueError(
                    f"version {facts['version']!r}, but this Protomark reads {VERSION}: update it"
                )
            shards = [shard_from(one) for one in facts["shards"]]
            made = {key: facts[key] for key in ("encoder", "dim", "appearance_bits", "metadata")}
            manifest = cls(**made, shards=shards, build=facts["build"])
            manifest.check()
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"cut off or broken: copy it again ({error})") from None
        except (KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"broken manifest of shards ({error!r})") from None
        return manifest

    def check(self) -> None:
        """Raise ValueError if names or numbers do not fit together."""
        if not self.shards:
            raise ValueError("a manifest of no shards")
        names = [shard.name for shard in self.shards]
        files = [file.name for shard in self.shards for file in shard.files]
        for group, what in ((names, "shards"), (files, "files of shards")):
            if len(set(group)) < len(group):
                raise ValueError(f"two {what} have one name")
        if any(Path(name).name != name or name.startswith(".") for name in files):
            raise ValueError("a shard's file is outside the folder")


def shard_from(facts: dict[str, Any]) -> Shard:
    """A shard by JSON values; raises ValueError, KeyError or TypeError."""
    rest = dict(facts)
    files = {
        kind: ShardFile(**found) if (found := rest.pop(kind)) else None
        for kind in ("learning", "sealed")
    }
    first, last = rest.pop("ids")
    box = rest.pop("box")
    shard = Shard(
        **rest, ids=(first, last), box=box and (tuple(box[0]), tuple(box[1])), learning=None
    )
    counts = (shard.landmarks, shard.prototypes, shard.placed, first, last)
    if not all(isinstance(n, int) and n >= 0 for n in counts) or not (
        0 < shard.landmarks <= last - first + 1 and any(files.values())
    ):
        raise ValueError(f"shard {shard.name!r} has counts that cannot be")
    return Shard(**{**vars(shard), **files})


def check_manifest(folder: Path) -> None:
    """Raise ValueError if a folder has a file of another kind where its manifest is to be."""
    path = folder / MANIFEST
    if path.is_file() and FORMAT.encode() not in path.read_bytes()[:100]:
        raise ValueError(f"{path} is no manifest of shards: name another folder")


def is_sharded(path: str | os.PathLike[str]) -> bool:
    """Whether a path is a folder of shards."""
    return (Path(path) / MANIFEST).is_file()


def describe_shard(
    name: str,
    scene: pm.PrototypeMap | pm.SealedMap,
    learning: ShardFile | None = None,
    sealed: ShardFile | None = None,
) -> Shard:
    """What a manifest says of a map and of the files that hold it."""
    summary, ids = scene.summary(), scene.ids
    if not len(ids):
        raise ValueError(f"shard {name} has no landmarks")
    extent = summary["extent"]
    return Shard(
        name,
        len(scene),
        scene.prototype_count,
        summary.get("observations"),
        (int(ids[0]), int(ids[-1])),
        summary["landmarks_with_position"],
        None if extent is None else (tuple(extent[0].tolist()), tuple(extent[1].tolist())),
        learning,
        sealed,
    )


def describe_file(path: Path) -> ShardFile:
    """What a manifest says of a map file."""
    lists = dict(pm.file_sections(path)).get("centroid", 0)
    nlist = pm.open(path).nlist if lists else 0
    return ShardFile(path.name, path.stat().st_size, file_identity(path), nlist)


def file_identity(path: Path) -> str:
    """SHA-256 of a container's header and section table, hexadecimal (docs/format.md).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no container.
    """
    with path.open("rb") as file:
        header = file.read(64)
        if len(header) < 64 or header[:8] != b"PROTOMRK":
            raise ValueError(f"{path} is no map file, or is cut off")
        sections = _HEADER.unpack_from(header)[4]
        table = file.read(32 * min(sections, 64))
    return hashlib.sha256(header + table).hexdigest()


def encoder_facts(encoder: pm.Encoder) -> dict[str, str]:
    """What a manifest says of an encoder."""
    return {
        "name": encoder.name,
        "identity": encoder.identity,
        "descriptor": encoder.descriptor,
    }


def disjoint(shards: Sequence[Shard]) -> bool:
    """Whether no two shards' ranges of ids overlap."""
    ranges = np.array(sorted(shard.ids for shard in shards)).reshape(-1, 2)
    return bool((ranges[:-1, 1] < ranges[1:, 0]).all())
