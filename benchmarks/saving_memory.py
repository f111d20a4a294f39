"""What saving and sealing take beside an open map: memory, and processor time.

python benchmarks/saving_memory.py [--landmarks 1000000] [--dims 8 16 32 64] [--json FILE]

Maps of random codes without positions, the smallest that there are for their landmarks: ids that
are 0 ... n - 1 and come in any order, and ids anywhere up to 2^40; with an index and without. The
map itself is what the process has allocated for it, the rest the peak of its resident memory while
it saves, from /proc (Linux, glibc).
"""

from __future__ import annotations

import argparse
import ctypes
import json
import re
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import protomark as pm
from protomark.bench.machine import allocated_bytes
from protomark.console import console, progress_bar


def resident(field: str) -> int:
    """Bytes of VmRSS, now, or VmHWM, at most since the last reset."""
    status = Path("/proc/self/status").read_text()
    found = re.search(rf"{field}:\s+(\d+) kB", status)
    assert found
    return 1024 * int(found[1])


def peak_of(work: Callable[[], object]) -> tuple[int, float]:
    """Bytes of resident memory at most beside what there was, and seconds of processor time."""
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")
    before, begin = resident("VmRSS"), time.process_time()
    work()
    return max(0, resident("VmHWM") - before), time.process_time() - begin


def map_of(n: int, dim: int, sparse: bool, rng: np.random.Generator) -> pm.PrototypeMap:
    """A map of n landmarks, one observation each."""
    ids = rng.choice(1 << 40, n, replace=False) if sparse else rng.permutation(n)
    scene = pm.PrototypeMap(pm.Encoder.load("freak"), dim=dim)
    for first in range(0, n, 1 << 17):
        some = ids[first : first + (1 << 17)]
        scene.add_codes(some, rng.integers(-127, 128, (len(some), dim), dtype=np.int8))
    return scene


def measure(n: int, dim: int, sparse: bool, index: bool, folder: Path) -> dict[str, Any]:
    """Of one map, as it is when it has been opened."""
    path = folder / "scene.pmk"
    made = map_of(n, dim, sparse, np.random.default_rng(0))
    if index:
        made.build_index()
    made.save(path)
    del made
    ctypes.CDLL(None).malloc_trim(0)
    before = allocated_bytes()
    scene = pm.open(path)
    after = allocated_bytes()
    assert isinstance(scene, pm.PrototypeMap)
    assert before is not None
    assert after is not None
    own = after - before
    result: dict[str, Any] = {"dim": dim, "sparse ids": sparse, "index": index, "map, bytes": own}
    for name, work in {
        "save": lambda: scene.save(path),
        "seal": lambda: scene.seal(folder / "sealed.pmk"),
        "seal, 4 bits": lambda: scene.seal(folder / "sealed.pmk", bits=4),
    }.items():
        peak, seconds = peak_of(work)
        result[f"{name}, share"] = peak / own
        result[f"{name}, processor ms"] = 1e3 * seconds
    return result


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--landmarks", type=int, default=1_000_000)
    parser.add_argument("--dims", type=int, nargs="+", default=[8, 16, 32, 64])
    parser.add_argument(
        "--folder", type=Path, help="where files are written; default: the system's"
    )
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    cases = [(dim, sparse, index) for dim in args.dims for sparse in (0, 1) for index in (0, 1)]
    results = []
    with (
        tempfile.TemporaryDirectory(prefix="protomark_saving_", dir=args.folder) as name,
        progress_bar() as bar,
    ):
        for dim, sparse, index in bar.track(cases, description="maps"):
            one = measure(args.landmarks, dim, bool(sparse), bool(index), Path(name))
            results.append(one)
            shares = ", ".join(
                f"{key.removesuffix(', share')} {100 * value:.1f} %"
                for key, value in one.items()
                if key.endswith("share")
            )
            kind = ("sparse ids" if sparse else "ids 0 ... n - 1") + (", index" if index else "")
            bytes_each = one["map, bytes"] / args.landmarks
            console.print(
                f"dim {dim}, {kind}: {bytes_each:.0f} bytes a landmark; {shares}", highlight=False
            )
    if args.json:
        facts = {"landmarks": args.landmarks, "version": pm.__version__, "maps": results}
        args.json.write_text(json.dumps(facts, indent=1) + "\n")


if __name__ == "__main__":
    main()
