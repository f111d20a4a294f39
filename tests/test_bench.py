"""`protomark bench`: what it measures on, how it chooses and reports; never how fast."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from protomark import _ceilings, sample
from protomark.bench import command, machine, peers, report
from protomark.bench.grown import Grown, map_of, prototypes_of, rounded_means
from protomark.bench.machine import allocated_bytes, last_level_cache
from protomark.bench.peers.network import bits_of, float_layers, selu
from protomark.bench.race import Contender, Pace, race
from protomark.bench.real import Observations
from protomark.bench.results import NOT_ASKED_FOR, Contest, Results, Timing
from protomark.bench.settings import Settings, choose
from protomark.bench.targets import outcomes
from protomark.bench.tuning import tune
from protomark.bench.workload import Workload
from protomark.tracks import Tracks


@pytest.fixture(scope="module")
def encoder() -> pm.Encoder:
    return pm.Encoder.load("freak")


@pytest.fixture(scope="module")
def real() -> Observations:
    return Observations.load([])


@pytest.fixture(scope="module")
def grown(real: Observations, encoder: pm.Encoder) -> Grown:
    return Grown(real, encoder, 32)


def test_real_observations_are_those_of_the_tracks(real: Observations) -> None:
    tracks = sample.load()
    often = np.unique(tracks.landmark_of_keypoint[tracks.observations], return_counts=True)[1]
    assert len(real) == (often >= 2).sum()
    assert real.counts.sum() == often[often >= 2].sum() - len(real)
    assert real.map_rows.sum() == real.counts.sum()
    both = np.concatenate([real.descriptors[real.map_rows], real.queries(np.arange(len(real)))])
    of_tracks = tracks.descriptors[tracks.observations]
    assert sorted(map(bytes, both)) == sorted(map(bytes, of_tracks))


def test_real_prototypes_are_those_of_a_map(real: Observations, encoder: pm.Encoder) -> None:
    scene = pm.PrototypeMap(encoder, dim=32)
    ids = np.repeat(np.arange(len(real)), real.counts)
    scene.add(ids, real.descriptors[real.map_rows])
    means = scene.prototype(np.arange(len(real)))
    expected = np.sign(means) * np.floor(np.abs(means) + 0.5)
    assert (prototypes_of(real, encoder, 32) == expected).all()


def test_tracks_of_two_descriptors_are_refused() -> None:
    tracks = sample.load()
    other: Tracks = replace(tracks, descriptor="orb")
    with pytest.raises(ValueError, match="one descriptor"):
        Observations.of([tracks, other], ["a", "b"])


def test_grown_landmarks_do_not_depend_on_how_many_are_made(grown: Grown) -> None:
    many = grown.prototypes(40_000)  # more than are made at a time
    assert (grown.prototypes(100) == many[:100]).all()
    assert (grown.prototypes(5_000, first=30_000) == many[30_000:35_000]).all()
    landmarks = np.array([39_999, 3, 32_768, 3])
    queries = grown.queries(landmarks)
    assert (queries[1] == queries[3]).all()
    assert (grown.queries(landmarks[:1])[0] == queries[0]).all()
    again = Grown(grown.real, grown.encoder, 32, seed=1).prototypes(100)
    assert (again != many[:100]).any()


def test_grown_prototypes_are_the_means_of_grown_descriptors(
    grown: Grown, encoder: pm.Encoder
) -> None:
    rows = grown.descriptors(50)
    assert rows.shape == (50 * grown.observations, 64)
    sums = encoder.encode(rows, dim=32).reshape(50, -1, 32).sum(axis=1, dtype=np.int32)
    assert (grown.prototypes(50) == rounded_means(sums, grown.observations)).all()


def test_bytes_of_a_grown_landmark_are_of_two_parents(grown: Grown, real: Observations) -> None:
    """Each byte, in all its observations, is one that its two parents have there."""
    recipe, _ = grown._recipe(0)
    rows = grown.descriptors(20).reshape(20, -1, 64)
    for i in range(20):
        for byte in range(64):
            parent = (recipe.second if recipe.crossed[i, byte] else recipe.first)[i]
            kept = slice(real.starts[parent], real.starts[parent + 1] - 1)
            assert set(rows[i, :, byte]) <= set(real.descriptors[kept, byte])


def test_parents_are_near_and_never_the_same(grown: Grown) -> None:
    recipe, _ = grown._recipe(0)
    assert (recipe.first != recipe.second).all()
    rows = prototypes_of(grown.real, grown.encoder, 32).astype(int)
    apart = np.square(rows[recipe.first] - rows[recipe.second]).sum(axis=1)
    others = np.random.default_rng(0).permutation(recipe.second)
    assert np.median(apart) < np.median(np.square(rows[recipe.first] - rows[others]).sum(axis=1))


def test_grown_queries_find_their_landmark_about_as_often_as_real_ones(
    real: Observations, grown: Grown, encoder: pm.Encoder
) -> None:
    n = len(real)
    landmarks = np.arange(0, n, 4)
    found = []
    for rows, queries in (
        (prototypes_of(real, encoder, 32), real.queries(landmarks)),
        (grown.prototypes(n), grown.queries(landmarks)),
    ):
        ids, _ = map_of(encoder, rows).search(queries, k=1)
        found.append((ids[:, 0] == landmarks).mean())
    assert abs(found[0] - found[1]) < 0.15


def test_tuner_takes_the_fastest_setting_that_finds_enough() -> None:
    recall = {1: 0.90, 2: 0.96, 3: 0.995, 4: 1.0, 11: 0.955, 12: 0.97}
    seconds = {1: 1.0, 2: 2.0, 3: 3.0, 4: 4.0, 11: 1.5, 12: 9.0}
    asked = []

    def measure(setting: int) -> tuple[float, float, int]:
        asked.append(setting)
        return recall[setting], seconds[setting], 100 + setting

    best = tune([[1, 2, 3, 4], [11, 12]], measure, (0.95, 0.99, 0.999))
    assert [trial and trial.setting for trial in best.values()] == [11, 3, 4]
    assert [trial and trial.queries for trial in best.values()] == [111, 103, 104]
    asked.clear()
    best = tune([[1, 2, 3, 4]], measure, (0.95, 0.99))
    assert [trial and trial.setting for trial in best.values()] == [2, 3]
    assert asked == [1, 2, 3]  # nothing is to be gained beyond
    assert tune([[1]], measure, (0.95,)) == {0.95: None}


def test_contenders_take_turns() -> None:
    turns: list[str] = []
    entrants = [Contender(name, lambda n, name=name: turns.append(name)) for name in "ab"]
    timings = race(entrants, 10, Pace(rounds=3, shortest=0))
    # Calls that take no time: one that is not timed, then three, and those whose time is planned.
    assert turns[-24:] == (["a"] * 4 + ["b"] * 4) * 3
    assert [len(timing.seconds) for timing in timings] == [3, 3]
    assert [timing.units for timing in timings] == [10, 10]


def test_a_turn_is_the_median_of_its_repetitions(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    # The warm-up, its timing, then turns of a call that does not count and three that do.
    lengths = iter([9.0, 0.01, 5.0, 0.005, 0.07, 0.02, 5.0, 0.03, 0.001, 0.03])

    def work(_: int) -> None:
        clock[0] += next(lengths)

    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    (timing,) = race([Contender("any", work)], 1, Pace(rounds=2, shortest=0.03))
    assert timing.seconds == pytest.approx([0.02, 0.03])


def test_long_calls_are_timed_once_a_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    lengths = iter([9.0, 0.2, 0.3, 0.4])

    def work(_: int) -> None:
        clock[0] += next(lengths)

    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    (timing,) = race([Contender("any", work)], 1, Pace(rounds=2))
    assert timing.seconds == pytest.approx([0.3, 0.4])


def test_slow_contenders_do_fewer_units() -> None:
    asked: list[int] = []

    def slow(n: int) -> None:
        asked.append(n)
        # Work that grows with n: what a turn may take is far less than for all units.
        np.random.default_rng(0).random((n, 20_000)).sort(axis=1)

    (timing,) = race([Contender("slow", slow, least=2)], 5_000, Pace(1, 0, 0.01))
    assert 2 <= timing.units < 5_000
    assert asked[-1] == timing.units


@pytest.mark.parametrize("name", ["freak", "orb"])
def test_float_network_is_the_encoder(name: str) -> None:
    encoder = pm.Encoder.load(name)
    descriptors = np.random.default_rng(0).integers(0, 256, (500, encoder.bits // 8), np.uint8)
    x = bits_of(descriptors).astype(np.float64)
    *hidden, last = float_layers(encoder, 32)
    for layer in hidden:
        x = selu(x @ layer.weights.T + layer.bias)
    codes = np.clip(x @ last.weights.T + last.bias, -127, 127)
    apart = np.abs(codes - encoder.encode(descriptors, dim=32))
    assert apart.mean() < 1
    assert apart.max() < 12


def test_peers_compute_the_same_network(encoder: pm.Encoder) -> None:
    descriptors = np.random.default_rng(0).integers(0, 256, (200, 64), np.uint8)
    codes = encoder.encode(descriptors, dim=32).astype(np.float64)
    bits, layers = bits_of(descriptors), float_layers(encoder, 32)
    runs = []
    if peers.installed("torch"):
        from protomark.bench.peers import torch_network

        runs.append(torch_network.runner(layers, bits))
    if peers.installed("onnxruntime", "onnx"):
        from protomark.bench.peers import onnx_network as onnx

        runs.append(onnx.runner(onnx.float_model(layers), bits.astype(np.float32), 1))
        runs.append(onnx.runner(onnx.static_model(layers), bits, 1))
        runs.append(onnx.runner(onnx.dynamic_model(layers), bits, 1))
    if not runs:
        pytest.skip("neither PyTorch nor ONNX Runtime is installed")
    for run in runs:
        assert np.abs(np.clip(run(200), -127, 127) - codes).mean() < 1


@pytest.fixture
def fixed() -> Results:
    """Made up: ours takes 1 unit of time, peers 3, 2 and 4."""

    def contest(section: str, names: list[str], own: str = "Protomark", **more: object) -> Contest:
        timings = [Timing(own, True, [1e-6, 1e-6, 1e-6], 100)]
        timings += [Timing(name, False, [3e-6, 2e-6, 4e-6], 50) for name in names]
        return Contest(section, section, "query", 1, 1_000_000, timings=timings, **more)  # type: ignore[arg-type]

    encode = replace(contest("encode", ["PyTorch float"]), work={"multiply_adds": 60_000.0})
    graphs = contest("approximate", ["FAISS HNSW", "hnswlib"], "Protomark, exact", recall=0.99)
    return Results(
        machine={"CPU": "a CPU"},
        data={"data": "some"},
        ceilings={"avx512": 100e9, "read": 10e9},
        contests=[
            encode,
            contest("search", ["FAISS IndexFlatL2"]),
            contest("hamming", ["OpenCV BFMatcher", "FAISS IndexBinaryFlat"]),
            replace(graphs, landmarks=100_000),
            graphs,
        ],
        resemblance={"IVF": [0.5, 0.6]},
        growth=[
            {"landmarks": n, "method": "exact", "seconds": n / 1e6, "bytes": 100.0, "recall": 1.0}
            for n in (1_000, 10_000)
        ],
        skipped=["hnswlib: not installed"],
    )


def test_targets_are_held_against_the_results(fixed: Results) -> None:
    rows = {(row.what, row.peer.partition(":")[0]): row for row in outcomes(fixed)}
    torch = rows["encode encode", "PyTorch float"]
    assert (torch.ratio, torch.target, torch.met) == ("3 (2 to 4)", "≥ 8 ×", False)
    ceiling = next(row for row in rows.values() if "60 %" in row.ours)
    assert ceiling.met
    assert not rows["exact search, 1 M landmarks", "FAISS IndexFlatL2"].met
    assert rows["exact search, 100 k landmarks; hnswlib at recall 0.99", "hnswlib"].met


def test_other_sizes_meet_and_miss_nothing(fixed: Results) -> None:
    fixed.contests = [replace(contest, landmarks=1_000) for contest in fixed.contests[1:]]
    rows = outcomes(fixed)
    assert rows
    assert all(row.met is None for row in rows)


def test_report_says_what_was_measured(fixed: Results, tmp_path: Path) -> None:
    text = command.write_report(fixed, tmp_path).read_text()
    assert "| PyTorch float | 3 µs | 3 (2 to 4) | 50 |" in text
    assert "ours worth 60 % of the vector ceiling" in text
    assert "| IVF | 0.500 | 0.600 |" in text
    assert "hnswlib: not installed" in text
    for name in ("ratios.svg", "growth.svg"):
        assert f"]({name})" in text
        assert (tmp_path / name).stat().st_size > 1_000
    assert report.rich_table(fixed).row_count == len(outcomes(fixed))


def test_results_survive_their_file(fixed: Results, tmp_path: Path) -> None:
    fixed.save(tmp_path / "bench.json")
    assert Results.load(tmp_path / "bench.json") == fixed
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(ValueError, match="not results"):
        Results.load(tmp_path / "other.json")


def test_missing_peers_are_named_with_their_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "find_spec", lambda module: None)
    notes = peers.missing()
    assert len(notes) == len(peers.DISTRIBUTIONS)
    assert "FAISS: not installed (pip install faiss-cpu" in "\n".join(notes)


@pytest.mark.parametrize("name", ["portable", None])
def test_instruction_set_is_the_one_in_use(name: str | None) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "PROTOMARK_ISA"}
    if name is not None:
        environment["PROTOMARK_ISA"] = name
    program = "import protomark as pm; print(pm.instruction_set())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, env=environment)
    said = done.stdout.decode().strip()
    assert said == name if name else said in ("amx", "avx512", "avx2", "neon", "portable")


def test_ceilings_are_named_by_instruction_set() -> None:
    rates = _ceilings.multiply_adds(0.01)
    assert all(rate > 1e9 for rate in rates.values())
    assert set(rates) <= {"avx2", "avx512", "amx", "neon"}
    assert _ceilings.read_bytes(5_000, 0.01) > 1e8
    with pytest.raises(ValueError, match="at least"):
        _ceilings.read_bytes(8)


def test_last_level_cache_is_one_of_this_machine() -> None:
    assert 1 << 15 <= last_level_cache() < 1 << 33


def test_allocated_memory_counts_what_a_map_holds() -> None:
    before = allocated_bytes()
    if before is None:
        pytest.skip("this C library does not say what is allocated")
    held = np.ones(1 << 22, np.uint8)
    after = allocated_bytes()
    assert after is not None
    assert abs(after - before - held.nbytes) < 1 << 16


def test_unknown_sections_are_refused() -> None:
    with pytest.raises(ValueError, match="no such section"):
        choose(
            sections=("flight",),
            threads=1,
            build_threads=1,
            full=False,
            quick=False,
            scratch=Path(),
        )


def test_sizes_of_maps_may_be_chosen(tmp_path: Path) -> None:
    common = {"sections": (), "threads": 1, "build_threads": 1, "full": False, "quick": False}
    chosen = choose(**common, scratch=tmp_path, landmarks=(500, 20, 500))  # type: ignore[arg-type]
    assert chosen.exact == chosen.approximate == chosen.growth == (20, 500)
    assert chosen.graphs_to == 500
    assert chosen.large == 0
    named = choose(**common, scratch=tmp_path, graphs=("faiss",))  # type: ignore[arg-type]
    assert named.graphs == ("faiss",)
    assert named.graphs_to == max(named.approximate)
    common["sections"] = ("large",)
    assert choose(**common, scratch=tmp_path, landmarks=(20, 500)).large == 500  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="--landmarks 0"):
        choose(**common, scratch=tmp_path, landmarks=(0,))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="--graphs tree"):
        choose(**common, scratch=tmp_path, graphs=("hnswlib", "tree"))  # type: ignore[arg-type]


def test_runs_are_joined_only_where_machine_and_data_are_the_same(tmp_path: Path) -> None:
    def run(landmarks: int, cpu: str = "a") -> Results:
        ours = Timing("Protomark", True, [1.0], 1)
        contest = Contest(
            "search",
            f"{landmarks} landmarks",
            "query",
            1,
            landmarks,
            work={"bytes": 1},
            timings=[ours],
        )
        facts = {**machine.describe(), "CPU": cpu}
        # A machine that was busier in the larger run.
        ceilings = {"read": 2.0 if landmarks == 10 else 4.0}
        ran = Results(facts, ceilings=ceilings, contests=[contest], command=f"bench {landmarks}")
        ran.save(tmp_path / "run.json")
        return Results.load(tmp_path / "run.json")

    results = run(10)
    results.extend(run(10))
    results.extend(run(20))
    shares = [(c.landmarks, results.share(c)) for c in results.contests]
    assert shares == [(10, 0.5), (20, 0.25)]  # each of its own run's ceiling
    assert results.command.split("\n    ") == ["bench 10", "bench 10", "bench 20"]
    alone = run(20)
    alone.skipped = ["peer, 20 landmarks: not asked for", "other, 20 landmarks: not asked for"]
    beside = run(20)
    beside.contests[0].timings.append(Timing("peer", False, [2.0], 1))
    beside.contests[0].title = "recall@1 of at least 0.98, 20 landmarks"
    alone.extend(beside)
    assert [len(c.timings) for c in alone.contests] == [1, 2]
    assert alone.skipped == ["other, 20 landmarks: not asked for"]
    with pytest.raises(ValueError, match="two machines"):
        results.extend(run(30, cpu="b"))
    other = run(30)
    other.machine["instruction set in use"] = "another"
    with pytest.raises(ValueError, match="two machines"):
        results.extend(other)


def test_joined_curves_are_in_order_and_without_twins() -> None:
    def run(*sizes: int, seconds: float = 1.0) -> Results:
        points = [
            {"landmarks": n, "method": method, "seconds": seconds * n, "bytes": None, "recall": 1.0}
            for n in sizes
            for method in ("exact", "approximate")
        ]
        return Results(growth=points)

    results = run(1_000, 10_000)
    results.extend(run(100, 10_000, seconds=5.0))
    assert [(p["landmarks"], p["method"]) for p in results.growth] == [
        (n, method) for n in (100, 1_000, 10_000) for method in ("exact", "approximate")
    ]
    assert [p["seconds"] for p in results.growth[::2]] == [500.0, 1_000.0, 10_000.0]
    assert all(row.what.startswith(("exact", "approximate")) for row in outcomes(results))
    assert outcomes(run(1_000)) == outcomes(Results(growth=run(1_000).growth * 2)) == []


def test_other_work_has_no_ratio(fixed: Results, tmp_path: Path) -> None:
    contest = fixed.contests[-1]
    contest.timings.append(Timing("LSH on bits", False, [9e-6] * 3, 50, comparable=False))
    assert contest.ratio(contest.timings[-1]) is None
    text = command.write_report(fixed, tmp_path).read_text()
    assert "| LSH on bits | 9 µs | – | 50 |" in text
    assert "LSH" not in (tmp_path / "ratios.svg").read_text()


def test_approximate_target_names_the_peers_raced(fixed: Results) -> None:
    fixed.contests = [
        replace(
            fixed.contests[-1],
            landmarks=10_000_000,
            recall=0.98,
            timings=[
                Timing("Protomark, approximate", True, [1e-6], 100),
                Timing("LSH on bits", False, [1e-7], 100, comparable=False),
                Timing("hnswlib", False, [3e-6], 100),
                Timing("FAISS IVF, SQ8", False, [2e-6], 100),
            ],
        )
    ]
    row = next(row for row in outcomes(fixed) if "raced" in row.peer)
    assert row.met
    assert row.peer == (
        "FAISS IVF, SQ8: 2 µs, the fastest of the peers raced: hnswlib, FAISS IVF, SQ8"
    )


def test_ctrl_c_keeps_what_is_measured(
    real: Observations, encoder: pm.Encoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setitem(command._RUN, "growth", stop)
    settings = Settings(sections=("add", "growth"), pace=Pace(1, 0, 0.01), map=200, encoded=50)
    results = command.measure(Workload(real, encoder, settings))
    assert results.interrupted
    assert [contest.section for contest in results.contests] == ["add"] * 2
    assert results.ceilings["read"] > 0


def test_figures_outlive_a_section_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise MemoryError

    monkeypatch.setitem(command._RUN, "growth", fail)
    settings = Settings(sections=("add", "growth"), pace=Pace(1, 0, 0.01), map=200, encoded=50)
    with pytest.raises(MemoryError):
        command.bench([], settings, json_path=tmp_path / "bench.json", repeat="again")
    kept = Results.load(tmp_path / "bench.json")
    assert [contest.section for contest in kept.contests] == ["add"] * 2
    assert kept.command == "again"
    assert kept.interrupted


def test_quick_run_from_end_to_end(tmp_path: Path) -> None:
    arguments = ["bench", "--quick", "-o", tmp_path / "report", "--json", tmp_path / "bench.json"]
    done = subprocess.run(
        [sys.executable, "-m", "protomark", *map(str, arguments)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    results = Results.load(tmp_path / "bench.json")
    sections = {contest.section for contest in results.contests}
    assert sections == {"encode", "search", "hamming", "approximate", "real", "frame", "add"}
    for contest in results.contests:
        assert contest.ours is not None
        for timing in contest.timings:
            assert len(timing.seconds) == 3
            assert min(timing.seconds) > 0
            assert timing.facts.get("recall", 1.0) >= (contest.recall or 0.0)
    assert not any("failed" in note for note in results.skipped), results.skipped
    assert not any(NOT_ASKED_FOR in note for note in results.skipped)
    assert {point["landmarks"] for point in results.growth} == {1_000, 3_000}
    assert results.large["8 bits: recall of the nearest of 8 bits"] >= 0.9
    assert results.large["4 bits: file bytes"] < results.large["8 bits: file bytes"]
    assert (tmp_path / "report" / "benchmarks.md").is_file()
    assert json.loads((tmp_path / "bench.json").read_text())["format"] == "protomark-bench"
