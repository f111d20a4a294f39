"""Kills saving processes, limits file sizes and fills disks; the map must stay whole.

    python tests/torture/run.py --kills 600

A child process saves three states of a file in turn and reports when each save has returned. The
script kills it (SIGKILL) at a random moment; the file must then contain the last saved state or the
next one, byte for byte. A map with a journal changes its state by commits, every fourth time by a
compaction; the script then compares the opened map. Killing a process does not lose data that the
system has accepted; core/tests/test_durability.cpp and test_journal_durability.cpp test that
everything is synced in the right order.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

import protomark as pm
from protomark import sample
from protomark.tracks.file import Tracks

Save = Callable[[Path], object]
LEFT_BEHIND = re.compile(r"target\.\d+|\.target\.[0-9a-f]{8}")
Report = Callable[[], object]


@dataclass
class Case:
    """Three states of one kind of file, and how each is saved."""

    name: str
    saves: list[Save]
    tracks: bool = False
    contents: list[bytes] = field(default_factory=list)
    seconds: float = 0
    size: int = 0  # bytes that the second save needs

    def holds(self, path: Path, state: int) -> bool:
        """Whether a file is whole and of this state."""
        if self.tracks:  # safetensors writes its metadata in any order
            return Tracks.load(path).info["state"] == state
        pm.verify_file(path)
        return path.read_bytes() == self.contents[state]

    def prepare(self, folder: Path) -> None:
        """Record each state and the time that saving takes."""
        begin = time.monotonic()
        for save in self.saves:
            save(folder / "target")
            self.contents.append((folder / "target").read_bytes())
        self.seconds = (time.monotonic() - begin) / len(self.saves)
        self.size = len(self.contents[1])
        (folder / "target").unlink()
        assert len(set(self.contents)) == len(self.contents)

    def start(self, path: Path) -> None:
        """Write the file that the saver replaces."""

    def run(self, path: Path, report: Report) -> None:
        """Save one state after the other, and report each."""
        for save in self.saves * 1000:
            save(path)
            report()

    def state_after(self, saves: int) -> int | None:
        """The state in the file afterwards; None: no file."""
        return (saves - 1) % len(self.saves) if saves else None


class Journal(Case):
    """A map whose commits and compactions go through all states and back to the first."""

    def __init__(self, name: str, first: pm.PrototypeMap, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.first = first
        self.some = [
            (
                rng.integers(0, 3 * len(first), 1000),
                rng.integers(-127, 128, (1000, first.dim), dtype=np.int8),
            )
            for _ in range(2)
        ]
        super().__init__(name, [self.save_first, self.save_second])

    def save_first(self, path: Path) -> None:
        journal_of(path).unlink(missing_ok=True)
        self.first.save(path)

    def save_second(self, path: Path) -> None:
        scene = opened(path)
        self.change(scene, 0)
        scene.commit()

    def change(self, scene: pm.PrototypeMap, state: int) -> None:
        """From this state to the next one."""
        if state < 2:
            scene.add_codes(*self.some[state])
            return
        for ids, codes in self.some:
            scene.subtract_codes(ids, codes)

    def holds(self, path: Path, state: int) -> bool:
        pm.verify_file(path)
        return self.bytes_of(pm.open(path), path) == self.contents[state]

    @staticmethod
    def bytes_of(scene: pm.PrototypeMap | pm.SealedMap, path: Path) -> bytes:
        assert isinstance(scene, pm.PrototypeMap)
        with tempfile.TemporaryDirectory(dir="/dev/shm") as name:
            scene.save(Path(name) / "state")
            return (Path(name) / "state").read_bytes()

    def prepare(self, folder: Path) -> None:
        path = folder / "target"
        self.save_first(path)
        begin = time.monotonic()
        scene = opened(path)
        for state in range(3):
            self.contents.append(self.bytes_of(scene, path))
            self.change(scene, state)
            if state == 0:
                scene.commit()
                self.size = journal_of(path).stat().st_size
        scene.compact()
        self.seconds = time.monotonic() - begin
        assert self.bytes_of(scene, path) == self.contents[0]
        assert len(set(self.contents)) == 3
        scene.close()
        path.unlink()
        journal_of(path).unlink()

    def start(self, path: Path) -> None:
        self.save_first(path)

    def run(self, path: Path, report: Report) -> None:
        scene = opened(path)
        for step in range(10_000):
            self.change(scene, step % 3)
            if step % 4 == 3:
                scene.compact()
            else:
                scene.commit()
            report()

    def state_after(self, saves: int) -> int | None:
        return saves % 3


def journal_of(path: Path) -> Path:
    return path.with_name(path.name + ".journal")


def opened(path: Path) -> pm.PrototypeMap:
    scene = pm.open(path, journal=True)
    assert isinstance(scene, pm.PrototypeMap)
    return scene


def scene(landmarks: int, appearance_bits: int, rng: np.random.Generator) -> pm.PrototypeMap:
    encoder = pm.Encoder.load("freak")
    result = pm.PrototypeMap(encoder, dim=16, appearance_bits=appearance_bits)
    for begin in range(0, landmarks, 1 << 20):
        ids = 3 * np.arange(begin, min(landmarks, begin + (1 << 20)))
        for _ in range(2):
            codes = rng.integers(-127, 128, (len(ids), 16), dtype=np.int8)
            result.add_codes(ids, codes)
    some = result.ids[::2]
    result.set_positions(some, rng.normal(0, 100, (len(some), 3)))
    return result


def cases(large: int, seed: int) -> list[Case]:
    rng = np.random.default_rng(seed)
    if large:
        maps = [scene(large + i, 0, rng) for i in range(3)]
        return [
            Case(f"learning map, {large} landmarks", [m.save for m in maps]),
            Case(
                f"sealed map, {large} landmarks",
                [partial(m.seal, bytes_per_landmark=9) for m in maps],
            ),
        ]
    small = [scene(100 + i, 0, rng) for i in range(3)]
    middle = [scene(20_000 + i, 4, rng) for i in range(3)]
    tracks = sample.load()
    described = [replace(tracks, info={"state": i}) for i in range(3)]
    encoders = [pm.Encoder.load(name) for name in ("freak", "orb", "brisk")]
    return [
        Case("learning map, 100 landmarks", [m.save for m in small]),
        Case("learning map, 20,000 landmarks with appearances", [m.save for m in middle]),
        Case("sealed map, 100 landmarks", [m.seal for m in small]),
        Case(
            "sealed map, 20,000 landmarks, words, appearances merged",
            [partial(m.seal, bytes_per_landmark=1.5 * 16 + 2) for m in middle],
        ),
        Journal("journal, map of 100 landmarks", scene(100, 0, rng), seed),
        Journal("journal, map of 20,000 landmarks with appearances", scene(20_000, 4, rng), seed),
        Case("encoder", [e.save for e in encoders]),
        Case("tracks", [t.save for t in described], tracks=True),
    ]


def left_behind(folder: Path) -> list[Path]:
    """Files beside the target; fails if a killed save may not leave them."""
    found = [p for p in folder.iterdir() if p.name not in ("target", "target.journal")]
    for path in found:
        assert LEFT_BEHIND.fullmatch(path.name), f"{path} was left behind"
    return found


def kill_once(case: Case, folder: Path, delay: float) -> str:
    """Kill a saver after `delay` seconds; the result says which state the file contains."""
    target = folder / "target"
    case.start(target)
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            case.run(target, lambda: os.write(writing, b"."))
        finally:
            os._exit(1)
    os.close(writing)
    time.sleep(delay)
    os.kill(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    assert os.WIFSIGNALED(status), "the saver ended by itself"
    saved = 0
    while block := os.read(reading, 1 << 16):
        saved += len(block)
    os.close(reading)
    old, new = case.state_after(saved), case.state_after(saved + 1)
    assert new is not None
    if not target.exists():
        assert old is None, "a saved file is gone"
        return "old"
    if old is not None and case.holds(target, old):
        return "old"
    assert case.holds(target, new), "neither the old nor the new file"
    return "new"


def is_torn(path: Path) -> bool:
    """Whether a commit was interrupted half-way."""
    if not journal_of(path).exists():
        return False
    journal = pm.file_journal(path)
    return journal is not None and journal["torn_bytes"] > 0


def kills(case: Case, folder: Path, n: int, rng: random.Random) -> Counter[str]:
    counts: Counter[str] = Counter()
    for _ in range(n):
        counts[kill_once(case, folder, rng.uniform(0, 2.5 * case.seconds))] += 1
        counts["within a save"] += bool(left_behind(folder)) or is_torn(folder / "target")
        for path in folder.iterdir():
            path.unlink()
    return counts


def refused(case: Case, folder: Path, prepare: Callable[[], object], cause: str) -> bool:
    """Save over state 0 under a limit; True if the save reached the limit and passed all checks.

    The child has the limit, so that this process keeps its own.
    """
    target = folder / "target"
    child = os.fork()
    if child == 0:
        code = 3
        try:
            prepare()
            case.saves[1](target)
            code = 2
        except OSError as error:
            code = 0 if cause in str(error) else 1
            if code:
                os.write(2, f"{error}\n".encode())
        finally:
            os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, 2), f"the saver ended with {code}"
    assert not left_behind(folder), "a failed save left a file behind"
    assert case.holds(target, 0 if code == 0 else 1), "neither the old nor the new file"
    return code == 0


def limit_file_size(size: int) -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def file_limits(case: Case, folder: Path, n: int, rng: random.Random) -> Counter[str]:
    counts: Counter[str] = Counter()
    for _ in range(n):
        case.saves[0](folder / "target")
        size = rng.randrange(case.size)
        met = refused(case, folder, partial(limit_file_size, size), "File too large")
        assert met, f"{size} bytes were enough"
        counts["old"] += 1
    return counts


@contextmanager
def small_disk(size: int) -> Iterator[Path | None]:
    """A disk in memory of `size` bytes, or None if this process may not mount one."""
    folder = Path(tempfile.mkdtemp(prefix="protomark_disk_"))
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    mounted = subprocess.run(mount, capture_output=True).returncode == 0
    try:
        yield folder if mounted else None
    finally:
        if mounted:
            subprocess.run(["umount", str(folder)], check=True)
        folder.rmdir()


def full_disks(case: Case, n: int, rng: random.Random) -> Counter[str] | None:
    counts: Counter[str] = Counter()
    size = len(case.contents[0]) + len(case.contents[1]) + (1 << 20)
    with small_disk(size) as folder:
        if folder is None:
            return None
        scratch = folder / "scene"
        scratch.mkdir()
        for _ in range(n):
            case.saves[0](scratch / "target")
            left = rng.randrange(case.size)
            with (folder / "ballast").open("wb") as ballast:
                os.posix_fallocate(ballast.fileno(), 0, shutil.disk_usage(folder).free - left)
            met = refused(case, scratch, lambda: None, "No space left on device")
            counts["old" if met else "fitted"] += 1
            (folder / "ballast").unlink()
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=600, help="over all kinds of files")
    parser.add_argument("--limits", type=int, default=300, help="file size limits, over all")
    parser.add_argument("--full", type=int, default=300, help="full disks, over all")
    parser.add_argument("--large", type=int, default=0, help="one map of so many landmarks only")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--folder", type=Path, help="where to save; default: the system's")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    seed = args.seed if args.seed is not None else random.SystemRandom().randrange(2**32)
    print(f"seed {seed}")
    rng = random.Random(seed)
    results: dict[str, dict[str, dict[str, int] | None]] = {}
    all_cases = cases(args.large, seed)
    for i, case in enumerate(all_cases):

        def share(total: int, i: int = i) -> int:
            return total * (i + 1) // len(all_cases) - total * i // len(all_cases)

        with tempfile.TemporaryDirectory(prefix="protomark_torture_", dir=args.folder) as name:
            folder = Path(name)
            case.prepare(folder)
            killed = kills(case, folder, share(args.kills), rng)
            limited = file_limits(case, folder, share(args.limits), rng)
        full = full_disks(case, share(args.full), rng)
        results[case.name] = {"kills": killed, "file size limits": limited, "full disks": full}
        print(
            f"{case.name} ({len(case.contents[0]):,} bytes, {1000 * case.seconds:.0f} ms a save): "
            f"{killed['old'] + killed['new']} kills, {killed['within a save']} of them within a "
            f"save, {killed['old']} old, {killed['new']} new; "
            f"{limited['old']} file size limits: all old; "
            + (
                "full disks: not run, no right to mount a tmpfs"
                if full is None
                else f"{full['old']} full disks: all old, {full['fitted']} had room: new"
            ),
            flush=True,
        )
        case.contents.clear()
    print(f"{args.kills} kills: every file old or new, whole")
    if args.json:
        args.json.write_text(json.dumps({"seed": seed, "cases": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
