"""Write docs/benchmarks.md and its plots from the JSON of `protomark bench`.

python benchmarks/bench_document.py [RESULTS.json]

Without an argument: from benchmarks/results/bench.json. Exit code 1 if a target was missed.
"""

from __future__ import annotations

import sys
from pathlib import Path

from protomark.bench import figures, report
from protomark.bench.results import Results
from protomark.bench.targets import outcomes
from protomark.files import write_text

ROOT = Path(__file__).parent.parent
DOCUMENT = ROOT / "docs" / "benchmarks.md"


def main() -> int:
    """Write the document, and say which targets were missed."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "benchmarks/results/bench.json"
    results = Results.load(path)
    plots = DOCUMENT.with_suffix("")
    plots.mkdir(exist_ok=True)
    names = [f"{plots.name}/{name}" for name in figures.save(results, plots)]
    write_text(DOCUMENT, report.markdown(results, names))
    missed = [row for row in outcomes(results) if row.met is False]
    for row in missed:
        print(f"missed: {row.what}, {row.peer}: {row.ours}, {row.ratio}; {row.target}")
    return 1 if missed else 0


if __name__ == "__main__":
    raise SystemExit(main())
