"""Journals: a commit survives a killed process and a truncated file."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import protomark as pm
from conftest import balanced_encoder, random_descriptors
from map_container import READER, container, sections
from mutation import FILES, SEED, bounded, mutated, mutated_container

Change = Callable[[pm.PrototypeMap], object]


def opened(path: Path) -> pm.PrototypeMap:
    scene = pm.open(path, journal=True)
    assert isinstance(scene, pm.PrototypeMap)
    return scene


def journal_of(path: Path) -> Path:
    return path.with_name(path.name + ".journal")


def state(scene: pm.PrototypeMap | pm.SealedMap, folder: Path) -> bytes:
    assert isinstance(scene, pm.PrototypeMap)
    scene.save(folder / "state")
    return (folder / "state").read_bytes()


def begin(path: Path, encoder: pm.Encoder, appearance_bits: int = 0) -> pm.PrototypeMap:
    pm.PrototypeMap(encoder, appearance_bits=appearance_bits).save(path)
    return opened(path)


def observe(scene: pm.PrototypeMap, seed: int, n: int = 40, ids: int = 20) -> None:
    rng = np.random.default_rng(seed)
    scene.add(rng.integers(0, ids, n), random_descriptors(n, seed=seed))


def joined(seed: int, encoder: pm.Encoder, appearance_bits: int) -> Change:
    other = pm.PrototypeMap(encoder, appearance_bits=appearance_bits)
    observe(other, seed, 5)
    return lambda scene: scene.merge_map(other)


seeds = st.integers(0, 100)
some = st.integers(0, 20)
changes = st.one_of(
    st.builds(lambda seed: ("add", seed), seeds),
    st.builds(lambda seed: ("halve", seed), seeds),
    st.builds(lambda seed: ("remove", seed), seeds),
    st.builds(lambda a, b: ("merge", a, b), some, some),
    st.builds(lambda a: ("discard", a), some),
    st.builds(lambda a, x: ("position", a, x), some, st.sampled_from([0.25, np.nan])),
    st.builds(lambda seed: ("update", seed), seeds),
    st.builds(lambda nlist: ("index", nlist), st.integers(0, 3)),
    st.builds(lambda text: ("metadata", text), st.sampled_from(["", "ENU, metres"])),
)


def apply(scene: pm.PrototypeMap, change: Any) -> None:
    with suppress(KeyError, ValueError):  # a call that fails changes nothing
        match change:
            case "add", seed:
                observe(scene, seed)
            case "halve", seed:
                observe(scene, seed, 600, ids=2)
            case "remove", seed:
                rng = np.random.default_rng(seed)
                scene.subtract(rng.integers(0, 20, 40), random_descriptors(40, seed=seed))
            case "merge", into, source:
                scene.merge_landmarks([into], [source])
            case "discard", landmark:
                scene.remove([landmark])
            case "position", landmark, x:
                scene.set_positions([landmark], [[x, x, x]])
            case "update", seed:
                joined(seed, scene.encoder, scene.appearance_bits)(scene)
            case "metadata", text:
                scene.metadata = {"frame": text} if text else {}
            case "index", nlist:
                scene.build_index(nlist) if nlist else scene.drop_index()


steps = st.one_of(changes, changes, changes, st.sampled_from(["commit", "compact", "open", "save"]))


@settings(max_examples=60)
@given(script=st.lists(steps, max_size=25), appearance_bits=st.sampled_from([0, 3]))
def test_any_history_equals_that_of_a_map_without_a_journal(
    script: list[Any], appearance_bits: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("journal")
    path = folder / "scene.pmk"
    scene = begin(path, balanced_encoder(), appearance_bits)
    plain = pm.PrototypeMap(scene.encoder, appearance_bits=appearance_bits)
    committed, since = state(plain, folder), []
    done: list[Any] = []
    for step in script:
        match step:
            case "commit" | "compact" | "save":
                scene.save(path) if step == "save" else getattr(scene, step)()
                done += since
                since = []
                committed = state(plain, folder)
            case "open":  # what was not committed is lost
                scene.close()
                scene = opened(path)
                plain = pm.PrototypeMap(scene.encoder, appearance_bits=appearance_bits)
                for change in done:
                    apply(plain, change)
                since = []
            case _:
                apply(scene, step)
                apply(plain, step)
                since.append(step)
        assert state(pm.open(path), folder) == committed
    assert state(scene, folder) == state(plain, folder)
    scene.close()


@pytest.fixture
def two_commits(encoder: pm.Encoder, tmp_path: Path) -> tuple[Path, int, list[bytes]]:
    """A map file, the bytes of its journal without the last commit, states after each commit."""
    path = tmp_path / "scene.pmk"
    with begin(path, encoder) as scene:
        observe(scene, 1)
        scene.commit()
        before = journal_of(path).stat().st_size
        states = [state(scene, tmp_path)]
        observe(scene, 2, 4)
        scene.remove([scene.ids[0]])
        assert journal_of(path).stat().st_size == before
    return path, before, [*states, state(scene, tmp_path)]


def test_a_torn_tail_at_every_byte_is_left_out(two_commits: tuple[Path, int, list[bytes]]) -> None:
    path, before, (old, new) = two_commits
    journal = journal_of(path)
    whole = journal.read_bytes()
    assert state(pm.open(path), path.parent) == new
    for size in range(before, len(whole)):
        journal.write_bytes(whole[:size])
        assert state(pm.open(path), path.parent) == old
        assert pm.file_journal(path) == {
            "commits": 1,
            "bytes": size,
            "torn_bytes": size - before,
        }
    left_out = 0
    for at in range(before, len(whole)):
        journal.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        found = state(pm.open(path), path.parent)
        assert found in (old, new)  # new where the byte is padding
        left_out += found == old
    assert left_out > (len(whole) - before) / 2
    # The tail is cut before the next commit.
    with opened(path) as scene:
        assert journal.stat().st_size in (before, len(whole))
        observe(scene, 3)
        kept = state(scene, path.parent)
    assert state(pm.open(path), path.parent) == kept


def test_a_broken_record_with_others_behind_it_is_refused(
    two_commits: tuple[Path, int, list[bytes]],
) -> None:
    path, before, _ = two_commits
    journal = journal_of(path)
    whole = bytearray(journal.read_bytes())
    first = sum(len(part) for part in containers(bytes(whole))[:1])
    whole[before - 64 * 8] ^= 1
    journal.write_bytes(whole)
    for read in (pm.open, opened, pm.verify_file, pm.file_journal):
        message = f"{journal}: record at byte {first} is broken, and another one follows"
        with pytest.raises(pm.FileError, match=message):
            read(path)
    assert journal.read_bytes() == whole


def test_a_journal_of_another_map_file_is_refused(
    two_commits: tuple[Path, int, list[bytes]], encoder: pm.Encoder
) -> None:
    path, _, (_, new) = two_commits
    base = path.read_bytes()
    other = pm.PrototypeMap(encoder)
    observe(other, 9)
    for save in (other.save, other.seal):
        with pytest.raises(pm.FileError, match="its journal holds 2 commits, which would be lost"):
            save(path)
    other.save(path.parent / "other.pmk")
    os.replace(path.parent / "other.pmk", path)
    with pytest.raises(pm.FileError, match="holds 2 commits to another map file"):
        pm.open(path)
    path.write_bytes(base)
    assert state(pm.open(path), path.parent) == new


def test_one_map_at_a_time_may_commit(encoder: pm.Encoder, tmp_path: Path) -> None:
    path = tmp_path / "scene.pmk"
    scene = begin(path, encoder)
    with pytest.raises(pm.FileError, match="is held by another map of this process"):
        opened(path)
    code = "import sys, protomark as pm; pm.open(sys.argv[1], journal=True)"
    command = [sys.executable, "-c", code, str(path)]
    found = subprocess.run(command, capture_output=True, text=True)
    assert f"is held by process {os.getpid()}" in found.stderr
    observe(scene, 1)
    scene.commit()
    assert len(pm.open(path)) == len(scene)
    scene.close()
    assert not scene.has_journal
    with pytest.raises(ValueError, match="has no journal"):
        scene.commit()
    assert subprocess.run(command, capture_output=True).returncode == 0
    again = opened(path)
    del again
    opened(path).close()


def test_a_map_of_another_encoder_gets_no_journal(encoder: pm.Encoder, tmp_path: Path) -> None:
    path = tmp_path / "scene.pmk"
    pm.PrototypeMap(encoder).save(path)
    with pytest.raises(ValueError, match=r"scene\.pmk: it was made with encoder"):
        pm.open(path, journal=True, encoder=balanced_encoder())
    with pytest.raises(ValueError, match=r"scene\.pmk: it is a map of .* descriptors, not of orb"):
        pm.open(path, journal=True, descriptor="orb")
    assert [file.name for file in tmp_path.iterdir()] == ["scene.pmk"]
    pm.open(path, journal=True, encoder=encoder).close()
    assert journal_of(path).exists()


def test_a_killed_process_leaves_its_commits_and_no_lock(
    encoder: pm.Encoder, tmp_path: Path
) -> None:
    path = tmp_path / "scene.pmk"
    scene = begin(path, encoder)
    scene.close()
    code = """
import os, signal, sys
import numpy as np
import protomark as pm
scene = pm.open(sys.argv[1], journal=True)
for landmark in range(3):
    scene.add_codes([landmark], np.full((1, 12), landmark, np.int8))
    scene.commit()
scene.add_codes([9], np.zeros((1, 12), np.int8))
os.kill(os.getpid(), signal.SIGKILL)
"""
    killed = subprocess.run([sys.executable, "-c", code, str(path)])
    assert killed.returncode == -signal.SIGKILL
    assert opened(path).ids.tolist() == [0, 1, 2]


def test_with_commits_where_all_went_well(encoder: pm.Encoder, tmp_path: Path) -> None:
    path = tmp_path / "scene.pmk"
    with begin(path, encoder) as scene:
        observe(scene, 1)
    assert len(pm.open(path)) == len(scene) > 0
    assert not scene.has_journal
    with pytest.raises(RuntimeError), opened(path) as scene:  # noqa: PT012
        scene.remove(scene.ids)
        raise RuntimeError
    assert len(pm.open(path)) > 0


def test_a_failed_commit_leaves_everything_for_the_next(
    encoder: pm.Encoder, tmp_path: Path
) -> None:
    resource = pytest.importorskip("resource")
    path = tmp_path / "scene.pmk"
    scene = begin(path, encoder)
    observe(scene, 1)
    scene.commit()
    committed = state(scene, tmp_path)
    observe(scene, 2)
    changed = state(scene, tmp_path)
    size = journal_of(path).stat().st_size
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 100, old[1]))
        with pytest.raises(pm.FileError, match=r"scene\.pmk\.journal: .*File too large"):
            scene.commit()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
        signal.signal(signal.SIGXFSZ, handler)
    assert journal_of(path).stat().st_size == size
    assert state(scene, tmp_path) == changed
    assert state(pm.open(path), tmp_path) == committed
    observe(scene, 3)
    assert scene.commit() > 0
    assert scene.commit() == 0
    assert state(pm.open(path), tmp_path) == state(scene, tmp_path)


def test_who_may_only_read_sees_the_commits(
    two_commits: tuple[Path, int, list[bytes]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path, _, (_, new) = two_commits
    for file in (path, journal_of(path)):
        file.chmod(0o444)
    path.parent.chmod(0o555)
    try:
        found = pm.open(path)
    finally:
        path.parent.chmod(0o755)
    assert state(found, tmp_path_factory.mktemp("state")) == new


def containers(journal: bytes) -> list[bytes]:
    parts = []
    while journal:
        size = int.from_bytes(journal[16:24], "little")
        parts.append(journal[:size])
        journal = journal[size:]
    return parts


def chained(parts: list[bytes]) -> bytes:
    """Joins containers to a journal with the right numbers and checksums."""
    result = [parts[0]]
    for number, part in enumerate(parts[1:], 1):
        chain = number.to_bytes(8, "little") + result[-1][28:32].ljust(8, b"\0")
        fields = [int.from_bytes(part[a : a + 4], "little") for a in (8, 12)]
        inside = [(name, chain if name == "chain" else c) for name, c in sections(part)]
        result.append(container(inside, *fields))
    return b"".join(result)


@pytest.mark.parametrize("appearance_bits", [0, 3])
def test_broken_journals_are_refused_or_read(appearance_bits: int, tmp_path: Path) -> None:
    print(f"PROTOMARK_SEED={SEED}")
    rng = np.random.default_rng(SEED)
    path = tmp_path / "scene.pmk"
    with begin(path, balanced_encoder(), appearance_bits) as scene:
        for seed in range(4):
            observe(scene, seed)
            scene.remove(scene.ids[:2])
            scene.set_positions(scene.ids[:3], np.ones((3, 3)))
            if seed == 2:
                scene.build_index(3)
            scene.commit()
    journal = journal_of(path)
    parts = containers(journal.read_bytes())
    assert chained(parts) == journal.read_bytes()
    refused = 0
    with bounded():
        for _ in range(FILES):
            some = list(parts)
            at = int(rng.integers(0, len(some)))
            match rng.integers(0, 8):
                case 0:
                    some.insert(at, some[int(rng.integers(0, len(some)))])
                case 1:
                    del some[at]
                case 2:
                    some = [mutated(b"".join(some), rng)]
                case _:
                    some[at] = mutated_container(some[at], rng)
            broken = b"".join(some)
            if rng.integers(0, 2) and len(some) > 1:
                with suppress(Exception):  # not containers any more
                    broken = chained(some)
            journal.write_bytes(broken)
            unnamed = False
            try:
                found = pm.open(path)
                assert len(found.ids) == len(found)
                found.search(random_descriptors(3))
                found.positions(found.ids)
            except pm.FileError as error:
                unnamed = not str(error).startswith(f"{journal}: ")
                refused += 1
            assert not unnamed
            for check in (pm.verify_file, pm.file_journal):
                with suppress(pm.FileError):
                    check(path)
    print(f"{refused} of {FILES} refused")
    assert FILES / 4 < refused < FILES


def landmarks_in(parts: dict[str, bytes], appearance_bits: int) -> dict[int, Any]:
    """Appearances, counts, sums and position of each landmark in a map or a commit."""
    n, dim = (int(v) for v in np.frombuffer(parts["shape"], "<u8", 2))
    assert int.from_bytes(parts.get("appbits", b""), "little") == appearance_bits
    ids = READER["landmark_ids"](parts, n).tolist()
    rows, appearances = READER["learning_rows"](parts, n)
    ends = np.cumsum(rows)[:-1]
    counts = np.frombuffer(parts["counts"], np.uint8)
    sums = READER["learning_sums"](parts, dim)
    positions = np.full((n, 3), np.nan)
    if "position" in parts:
        positions = np.frombuffer(parts["position"], "<f8").reshape(n, 3)
    values = [np.split(array, ends) if n else [] for array in (appearances, counts, sums)]
    return {
        i: ([v.tolist() for v in one], positions[k].tolist())
        for k, (i, one) in enumerate(zip(ids, zip(*values, strict=True), strict=True))
    }


def replayed(base: bytes, journal: bytes, appearance_bits: int) -> dict[int, Any]:
    """Reads the landmarks of a map and its journal by docs/format.md."""
    size = 64 + 32 * int.from_bytes(base[24:28], "little")
    identity = hashlib.sha256(base[:size]).hexdigest().encode()
    landmarks = landmarks_in(dict(sections(base)), appearance_bits)
    head, *records = containers(journal)
    kinds = [part[12] for part in (head, *records)]
    assert kinds[0] == 4
    names = [dict(sections(part)).get("base") for part in (head, *records)]
    last = max(i for i, name in enumerate(names) if name == identity)
    previous = head
    for number, record in enumerate(records, 1):
        parts = dict(sections(record))
        chain = number.to_bytes(8, "little") + previous[28:32] + bytes(4)
        assert parts["chain"] == chain
        previous = record
        if number <= last or record[12] != 5:
            continue
        for removed in np.frombuffer(parts.get("removed", b""), "<i8").tolist():
            landmarks.pop(removed, None)
        landmarks |= landmarks_in(parts, appearance_bits)
    return landmarks


@pytest.mark.parametrize("appearance_bits", [0, 3])
def test_a_reader_can_be_written_from_the_format(appearance_bits: int, tmp_path: Path) -> None:
    path = tmp_path / "scene.pmk"
    scene = begin(path, balanced_encoder(), appearance_bits)
    for seed in range(12):
        observe(scene, seed, 10)
        if seed % 3 == 1:
            scene.remove(scene.ids[:2])
            scene.set_positions(scene.ids[:2], np.full((2, 3), seed))
        scene.commit()
        if seed == 5:
            scene.compact()
        whole = dict(sections(state(scene, tmp_path)))
        found = replayed(path.read_bytes(), journal_of(path).read_bytes(), appearance_bits)
        expected = landmarks_in(whole, appearance_bits)
        assert repr(sorted(found.items())) == repr(sorted(expected.items()))


def test_a_journal_that_was_moved_takes_no_commit(encoder: pm.Encoder, tmp_path: Path) -> None:
    path = tmp_path / "scene.pmk"
    scene = begin(path, encoder)
    observe(scene, 1)
    scene.commit()
    journal_of(path).rename(tmp_path / "away")
    observe(scene, 2)
    with pytest.raises(pm.FileError, match=r"scene\.pmk\.journal: was moved or deleted"):
        scene.commit()
    (tmp_path / "away").rename(journal_of(path))
    assert scene.commit() > 0
    assert state(pm.open(path), tmp_path) == state(scene, tmp_path)


def test_a_hard_link_of_the_map_is_another_file(encoder: pm.Encoder, tmp_path: Path) -> None:
    path, link = tmp_path / "scene.pmk", tmp_path / "link.pmk"
    scene = begin(path, encoder)
    link.hardlink_to(path)
    observe(scene, 1)
    scene.commit()
    scene.save(link)
    assert len(pm.open(link)) == len(scene) > 0
    assert pm.file_journal(path)["commits"] == 1  # type: ignore[index]


def test_named_pipes_are_refused(encoder: pm.Encoder, tmp_path: Path) -> None:
    path = tmp_path / "scene.pmk"
    pm.PrototypeMap(encoder).save(path)
    os.mkfifo(journal_of(path))
    os.mkfifo(tmp_path / "pipe.pmk")
    for call in (pm.open, partial(pm.open, journal=True), pm.PrototypeMap(encoder).save):
        with pytest.raises(pm.FileError, match="not a file"):
            call(path)  # type: ignore[operator]
    with pytest.raises(pm.FileError, match="not a file"):
        pm.open(tmp_path / "pipe.pmk")
