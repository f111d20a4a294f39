"""`protomark bench`: its data, choices and report; no test depends on speed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from conftest import program
from protomark import sample
from protomark.tracks import Tracks
from protomark_bench import _ceilings
from protomark_bench.machine import allocated_bytes, last_level_cache
from protomark_bench.speed import command, peers
from protomark_bench.speed.approximate import NOT_NAMED, IndexTrial, tune
from protomark_bench.speed.landmarks import (
    RealLandmarks,
    SyntheticLandmarks,
    Workload,
    map_of,
    rounded_means,
)
from protomark_bench.speed.peers.network import bits_of, float_layers, selu
from protomark_bench.speed.race import Contender, Contest, Pace, Timing, race
from protomark_bench.speed.results import BenchResults
from protomark_bench.speed.settings import BenchSettings, settings_of


@pytest.fixture(scope="module")
def encoder() -> pm.Encoder:
    return pm.Encoder.load("freak")


@pytest.fixture(scope="module")
def real() -> RealLandmarks:
    return RealLandmarks.load([])


@pytest.fixture(scope="module")
def synthetic(real: RealLandmarks, encoder: pm.Encoder) -> SyntheticLandmarks:
    return SyntheticLandmarks(real, encoder, 32)


def test_real_observations_are_those_of_the_tracks(real: RealLandmarks) -> None:
    tracks = sample.load()
    often = np.unique(tracks.landmark_of_keypoint[tracks.observations], return_counts=True)[1]
    assert len(real) == (often >= 2).sum()
    assert real.counts.sum() == often[often >= 2].sum() - len(real)
    assert real.in_map.sum() == real.counts.sum()
    both = np.concatenate([real.descriptors[real.in_map], real.queries(np.arange(len(real)))])
    of_tracks = tracks.descriptors[tracks.observations]
    assert sorted(map(bytes, both)) == sorted(map(bytes, of_tracks))


def test_real_prototypes_are_those_of_a_map(real: RealLandmarks, encoder: pm.Encoder) -> None:
    scene = pm.PrototypeMap(encoder, dim=32)
    ids = np.repeat(np.arange(len(real)), real.counts)
    scene.add(ids, real.descriptors[real.in_map])
    means = scene.prototypes(np.arange(len(real)))
    expected = np.sign(means) * np.floor(np.abs(means) + 0.5)
    assert (real.prototypes(encoder, 32) == expected).all()


def test_tracks_of_two_descriptors_are_refused() -> None:
    tracks = sample.load()
    other: Tracks = replace(tracks, descriptor="orb")
    with pytest.raises(ValueError, match="one descriptor"):
        RealLandmarks.of([tracks, other], ["a", "b"])


def test_synthetic_landmarks_do_not_depend_on_how_many_are_made(
    synthetic: SyntheticLandmarks,
) -> None:
    many = synthetic.prototypes(40_000)  # more than are made at a time
    assert (synthetic.prototypes(100) == many[:100]).all()
    assert (synthetic.prototypes(5_000, first=30_000) == many[30_000:35_000]).all()
    landmarks = np.array([39_999, 3, 32_768, 3])
    queries = synthetic.queries(landmarks)
    assert (queries[1] == queries[3]).all()
    assert (synthetic.queries(landmarks[:1])[0] == queries[0]).all()
    again = SyntheticLandmarks(synthetic.real, synthetic.encoder, 32, seed=1).prototypes(100)
    assert (again != many[:100]).any()


def test_synthetic_prototypes_are_the_means_of_synthetic_descriptors(
    synthetic: SyntheticLandmarks, encoder: pm.Encoder
) -> None:
    rows = synthetic.descriptors(50)
    assert rows.shape == (50 * synthetic.observations, 64)
    sums = encoder.encode(rows, dim=32).reshape(50, -1, 32).sum(axis=1, dtype=np.int32)
    assert (synthetic.prototypes(50) == rounded_means(sums, synthetic.observations)).all()


def test_bytes_of_a_synthetic_landmark_are_of_two_parents(
    synthetic: SyntheticLandmarks, real: RealLandmarks
) -> None:
    """In all observations each byte comes from one of the two parents."""
    parents, _ = synthetic._parents(0)
    rows = synthetic.descriptors(20).reshape(20, -1, 64)
    for i in range(20):
        for byte in range(64):
            parent = (parents.second if parents.from_second[i, byte] else parents.first)[i]
            used = slice(real.starts[parent], real.starts[parent + 1] - 1)
            assert set(rows[i, :, byte]) <= set(real.descriptors[used, byte])


def test_parents_are_near_and_never_the_same(synthetic: SyntheticLandmarks) -> None:
    parents, _ = synthetic._parents(0)
    assert (parents.first != parents.second).all()
    rows = synthetic.real.prototypes(synthetic.encoder, 32).astype(int)
    apart = np.square(rows[parents.first] - rows[parents.second]).sum(axis=1)
    others = np.random.default_rng(0).permutation(parents.second)
    assert np.median(apart) < np.median(np.square(rows[parents.first] - rows[others]).sum(axis=1))


def test_synthetic_queries_find_their_landmark_about_as_often_as_real_ones(
    real: RealLandmarks, synthetic: SyntheticLandmarks, encoder: pm.Encoder
) -> None:
    n = len(real)
    landmarks = np.arange(0, n, 4)
    found = []
    for rows, queries in (
        (real.prototypes(encoder, 32), real.queries(landmarks)),
        (synthetic.prototypes(n), synthetic.queries(landmarks)),
    ):
        ids, _ = map_of(encoder, rows).search(queries, k=1)
        found.append((ids[:, 0] == landmarks).mean())
    assert abs(found[0] - found[1]) < 0.15


def test_tuner_takes_the_fastest_setting_that_finds_enough() -> None:
    recall = {1: 0.90, 2: 0.96, 3: 0.995, 4: 1.0, 11: 0.955, 12: 0.97}
    seconds = {1: 1.0, 2: 2.0, 3: 3.0, 4: 4.0, 11: 1.5, 12: 9.0}
    asked = []

    def measure(setting: int) -> IndexTrial:
        asked.append(setting)
        return IndexTrial(setting, recall[setting], seconds[setting], 100 + setting)

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
        from protomark_bench.speed.peers import torch_network

        runs.append(torch_network.runner(layers, bits))
    if peers.installed("onnxruntime", "onnx"):
        from protomark_bench.speed.peers import onnx_network as onnx

        runs.append(onnx.runner(onnx.float_model(layers), bits.astype(np.float32), 1))
        runs.append(onnx.runner(onnx.static_model(layers), bits, 1))
        runs.append(onnx.runner(onnx.dynamic_model(layers), bits, 1))
    if not runs:
        pytest.skip("neither PyTorch nor ONNX Runtime is installed")
    for run in runs:
        assert np.abs(np.clip(run(200), -127, 127) - codes).mean() < 1


@pytest.fixture
def fixed() -> BenchResults:
    """Synthetic timings: ours takes 1 unit of time, the peers 3, 2 and 4."""

    def contest(section: str, names: list[str], **more: object) -> Contest:
        timings = [Timing("Protomark", True, [1e-6, 1e-6, 1e-6], 100)]
        timings += [Timing(name, False, [3e-6, 2e-6, 4e-6], 50) for name in names]
        return Contest(section, section, "query", 1, 1_000_000, timings=timings, **more)  # type: ignore[arg-type]

    return BenchResults(
        machine={"CPU": "a CPU"},
        data={"data": "some"},
        ceilings={"avx512": 100e9, "amx": 900e9, "read": 10e9},
        contests=[
            contest("encode", ["PyTorch float"], work={"multiply_adds": 60_000.0}),
            contest("hamming", ["OpenCV BFMatcher", "FAISS IndexBinaryFlat"]),
            contest("approximate", ["hnswlib"], recall=0.99),
        ],
        resemblance={"IVF": [0.5, 0.6]},
        growth=[
            {"landmarks": n, "method": "exact", "seconds": n / 1e6, "bytes": 100.0, "recall": 1.0}
            for n in (1_000, 10_000)
        ],
        skipped=["hnswlib is not installed"],
    )


def test_report_says_what_was_measured(fixed: BenchResults, tmp_path: Path) -> None:
    fixed.report().publish(tmp_path)
    text = (tmp_path / "benchmarks.md").read_text()
    assert "| PyTorch float | 3 µs | 3 (2 to 4) | 50 |" in text
    assert "| encode: encode, 1 thread | 1 µs | PyTorch float: 3 µs | 3 (2 to 4) |" in text
    assert "Protomark worth 60 % of the vector ceiling" in text
    assert "| IVF | 0.500 | 0.600 |" in text
    assert "hnswlib is not installed" in text
    for name in ("ratios", "growth"):
        assert f"](benchmarks-{name}.svg)" in text
        assert (tmp_path / f"benchmarks-{name}.svg").stat().st_size > 1_000
    assert len(fixed.summary().rows) == 3


def test_results_survive_their_file(fixed: BenchResults, tmp_path: Path) -> None:
    fixed.report().publish(tmp_path)
    assert BenchResults.load(tmp_path / "benchmarks.json") == fixed
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(ValueError, match="no results of the format protomark-bench"):
        BenchResults.load(tmp_path / "other.json")


def test_other_work_has_no_ratio(fixed: BenchResults) -> None:
    contest = fixed.contests[-1]
    contest.timings.append(Timing("LSH on bits", False, [9e-6] * 3, 50, comparable=False))
    assert contest.ratio(contest.timings[-1]) is None
    report = fixed.report()
    assert "| LSH on bits | 9 µs | – | 50 |" in report.markdown
    assert "hnswlib" in "".join(fixed.summary().rows[-1])
    labels = [tick.get_text() for tick in report.plots["ratios"].axes[0].get_yticklabels()]
    assert labels
    assert not any("LSH" in label for label in labels)


def test_missing_peers_are_named_with_their_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "find_spec", lambda module: None)
    notes = peers.missing()
    assert len(notes) == len(peers.DISTRIBUTIONS)
    assert "faiss-cpu is not installed (pip install faiss-cpu)" in notes


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


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="--only flight: no such section"):
        settings_of("usual", ("flight",), 1)
    with pytest.raises(ValueError, match="--scale huge: give quick"):
        settings_of("huge", (), 1)
    with pytest.raises(ValueError, match="--landmarks 0"):
        BenchSettings().at((0,))
    with pytest.raises(ValueError, match="--graphs tree"):
        BenchSettings().with_graphs("hnswlib,tree")


def test_sizes_of_maps_may_be_chosen() -> None:
    chosen = settings_of("usual", (), 1).at((500, 20, 500))
    assert chosen.exact == chosen.approximate == chosen.growth == (20, 500)
    assert (chosen.map, chosen.graphs_limit, chosen.large) == (500, 500, 0)
    assert settings_of("usual", ("large",), 1).at((20, 500)).large == 500
    assert settings_of("quick", (), 1).at((20, 500)).large == 500
    named = BenchSettings().with_graphs("faiss")
    assert named.graphs == ("faiss",)
    assert named.graphs_limit == max(named.approximate)


SHORT = BenchSettings(sections=("add", "growth"), pace=Pace(1, 0, 0.01), map=200, encoded=50)


def test_ctrl_c_keeps_what_is_measured(
    real: RealLandmarks, encoder: pm.Encoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setitem(command.SECTION_FUNCTIONS, "growth", stop)
    results = command.measure(Workload(real, encoder), SHORT)
    assert results.interrupted
    assert [contest.section for contest in results.contests] == ["add"] * 2
    assert results.ceilings["read"] > 0


def test_figures_outlive_a_section_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: object) -> None:
        raise MemoryError

    monkeypatch.setitem(command.SECTION_FUNCTIONS, "growth", fail)
    with pytest.raises(MemoryError):
        command.bench([], SHORT, tmp_path, "again")
    found = BenchResults.load(tmp_path / "benchmarks.json")
    assert [contest.section for contest in found.contests] == ["add"] * 2
    assert found.command == "again"
    assert found.interrupted


def test_quick_run_from_end_to_end(tmp_path: Path) -> None:
    done = program("bench", "--scale", "quick", "--landmarks", "1000", "-o", tmp_path)
    assert done.returncode == 0, done.stderr
    results = BenchResults.load(tmp_path / "benchmarks.json")
    sections = {contest.section for contest in results.contests}
    assert sections == {"encode", "search", "hamming", "approximate", "real", "frame", "add"}
    for contest in results.contests:
        assert contest.ours is not None
        for timing in contest.timings:
            assert len(timing.seconds) == 3
            assert min(timing.seconds) > 0
            assert timing.facts.get("recall", 1.0) >= (contest.recall or 0.0)
    assert not any("failed" in note for note in results.skipped), results.skipped
    assert not any(NOT_NAMED in note for note in results.skipped)
    assert {point["landmarks"] for point in results.growth} == {1_000}
    assert results.large["int8: recall of the nearest of int8"] >= 0.9
    assert results.large["words: file bytes"] < results.large["int8: file bytes"]
    assert results.command == "protomark bench --scale quick --landmarks 1000"
    assert (tmp_path / "benchmarks.md").is_file()
