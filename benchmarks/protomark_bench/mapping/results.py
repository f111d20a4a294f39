"""Results of an evaluation of mapping, as JSON and as a page."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from protomark_bench import plot
from protomark_bench.report import Part, Report, ReportTable, facts, load_json, number, picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME, FORMAT, VERSION = "mapping", "protomark-mapping-evaluation", 1
TRADITIONAL, PROTOTYPES, COLMAP = "traditional", "prototypes-32", "colmap"
LABELS = {
    TRADITIONAL: "all descriptors",
    "medoid": "medoid",
    PROTOTYPES: "prototypes, 32",
    "prototypes-16": "prototypes, 16",
    COLMAP: "COLMAP, SIFT",
}
_COLORS = {
    TRADITIONAL: plot.AMBER,
    "medoid": plot.VIOLET,
    PROTOTYPES: plot.TEAL,
    "prototypes-16": plot.BLUE,
    COLMAP: plot.RED,
}


@dataclass(frozen=True)
class Drift:
    """A map that was built frame by frame, beside maps that are built at once.

    Attributes:
        landmarks: landmarks of the map.
        observations: observations that were added to the map and not subtracted.
        same_file: whether a map of these observations, built at once, has the same bytes.
        different: landmarks whose count or prototype differs between the two.
        dropped: observations that proved wrong after their descriptors had been dropped: they have
            left the geometry, but stay in the prototype.
        different_from_frames: landmarks that differ from a map of the frames' observations at the
            end: those with dropped observations.
        halved: landmarks with more than 255 observations, whose sums were halved.
    """

    landmarks: int
    observations: int
    same_file: bool
    different: int
    dropped: int
    different_from_frames: int
    halved: int


@dataclass(frozen=True)
class MappingRun:
    """One memory, or COLMAP, on one sequence.

    Attributes:
        memory: name of the memory.
        registered: number of images with a pose.
        error: root mean square error of camera centres after the best similarity, in the unit of
            the true poses; None with too few poses.
        common_errors: the error on images that the traditional map registered, too, and that map's
            error on them.
        landmarks: number of landmarks.
        observations: number of observations.
        memory_bytes: bytes that matching needs for all landmarks at the end, without positions;
            None for COLMAP, which keeps every descriptor of every image.
        peak_bytes: largest `memory_bytes` after any frame.
        peak_window_bytes: largest bytes of map and window together after any frame.
        learning_bytes: bytes of prototypes that can be updated.
        seconds: CPU seconds of all frames by stage.
        wall_seconds: elapsed seconds.
        search_ms: CPU milliseconds to encode and search a frame's descriptors in the whole map at
            the end, median over frames.
        error_pixels: mean reprojection error.
        not_registered: number of images by reason.
        events: closed loops, aborted initialisations and the like.
        drift: drift of prototypes.
        centers: camera centres by name, of images with a pose.
        growth: bytes of the map after each frame.
    """

    memory: str
    registered: int
    landmarks: int
    observations: int
    memory_bytes: int | None
    peak_bytes: int | None
    peak_window_bytes: int | None
    learning_bytes: int | None
    seconds: dict[str, float]
    wall_seconds: float
    search_ms: float | None
    error_pixels: float
    error: float | None = None
    common_errors: tuple[float, float] | None = None
    not_registered: dict[str, int] = field(default_factory=dict)
    events: list[str] = field(default_factory=list)
    drift: Drift | None = None
    centers: dict[str, list[float]] = field(default_factory=dict)
    growth: list[int] = field(default_factory=list)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> MappingRun:
        """The run of values that `dataclasses.asdict` returned.

        Raises:
            TypeError, KeyError: these are not the values of a run.
        """
        drift = values.pop("drift")
        return cls(drift=None if drift is None else Drift(**drift), **values)

    @property
    def label(self) -> str:
        """The name in tables."""
        return LABELS.get(self.memory, self.memory)

    @property
    def total(self) -> float:
        """CPU seconds of all stages."""
        return sum(self.seconds.values())

    @property
    def matching(self) -> float:
        """CPU seconds to find frames in the map: codes, matches and poses."""
        return self.seconds.get("encode", 0.0) + self.seconds.get("match", 0.0)


@dataclass(frozen=True)
class MappedSequence:
    """All runs on one sequence.

    Attributes:
        name: name of the sequence.
        frames: number of images in the runs.
        available: number of images of the sequence.
        truth: origin of the true poses.
        extent: diagonal of the box around the true camera centres.
        runs: runs by memory.
        true_centers: true camera centres by image name.
        plane: (2, 3) axes of the ground plane, for the view from above.
    """

    name: str
    frames: int
    available: int
    truth: str
    extent: float
    runs: dict[str, MappingRun]
    true_centers: dict[str, list[float]] = field(default_factory=dict)
    plane: list[list[float]] = field(default_factory=list)


@dataclass(frozen=True)
class MappingResults:
    """The content of the report.

    Attributes:
        sequences: results of each sequence.
        missing: runs that Ctrl-C prevented, as "sequence, memory".
        conditions: conditions of the runs, by name.
    """

    sequences: list[MappedSequence]
    missing: list[str]
    conditions: dict[str, str]

    @classmethod
    def load(cls, path: Path) -> MappingResults:
        """Reads the JSON of a report.

        Raises:
            FileNotFoundError, ValueError: the file is missing or holds no such results.
        """
        values = load_json(path, FORMAT)
        sequences = []
        for entry in values.pop("sequences"):
            runs = {name: MappingRun.from_dict(run) for name, run in entry.pop("runs").items()}
            sequences.append(MappedSequence(runs=runs, **entry))
        return cls(sequences, **values)

    def as_dict(self) -> dict[str, Any]:
        """The results as JSON values."""
        return {"format": FORMAT, "version": VERSION, **asdict(self)}

    def report(self) -> Report:
        """The report: page, plots and JSON."""
        plots = {"ratios": draw_ratios(self)}
        if all(s.true_centers for s in self.sequences):
            plots["trajectories"] = draw_trajectories(self)
        if any(run.growth for _, run in self._runs()):
            plots["memory"] = draw_memory(self)
        columns = (0, 1, 2, 4, 5, 7, 8)
        tables = [
            _runs_table(s).rich(f"{s.name}, {s.frames} frames", columns) for s in self.sequences
        ]
        notes = [f"not run: {missing}" for missing in self.missing]
        command = "protomark evaluate-mapping"
        return Report(NAME, command, self.as_dict(), self._parts(), plots, tables, notes)

    def _runs(self) -> Iterator[tuple[MappedSequence, MappingRun]]:
        return ((s, run) for s in self.sequences for run in s.runs.values())

    def _parts(self) -> list[Part]:
        scale = "; ".join(f"{s.name} {s.frames} of {s.available}" for s in self.sequences)
        parts: list[Part] = [
            "# Mapping evaluated",
            "The incremental pipeline of `protomark map` on whole sequences, its poses unknown, "
            "with several memories in the same code: all descriptors of every landmark, searched "
            "by Hamming distance (the traditional way), the medoid of each landmark, and "
            "prototypes. Beside it COLMAP's own incremental reconstruction with SIFT on the same "
            "images. Written by `protomark evaluate-mapping`.",
            f"**Scale of this run:** {self.conditions['scale']}. {scale}."
            + (f" **Not run:** {'; '.join(self.missing)}." if self.missing else ""),
            "## Prototypes beside all descriptors",
            "Prototypes of 32 numbers (33 bytes) beside the traditional map: frames registered by "
            "both and by COLMAP, the ratio of trajectory errors on frames that both registered, "
            "the ratio of descriptor memory and of the time to find a frame in the map, and "
            "whether a map made at once has the same bytes (see Drift).",
            self._beside(),
            picture(NAME, "ratios", "Ratios"),
            "## Runs",
            "Error: root mean square of the distance between camera centres after the best "
            "similarity (as `evo_ape -as`), in the unit of the true poses, and as a share of the "
            "diagonal of the box around the true cameras. KB: what matching needs of all landmarks "
            "at the end (their positions left out), 1 KB = 1000 bytes. Milliseconds are CPU time "
            "of all stages. Matching is encoding, searching, and the pose of a frame in the map, "
            "initialization left out; whole search is a frame's descriptors against the whole map "
            "of the end, encoding included. Pixels: mean reprojection error. COLMAP's times are "
            "of features, matching of image pairs, and mapping; it keeps every descriptor of every "
            "image, 128 bytes each.",
        ]
        for s in self.sequences:
            title = f"**{s.name}**, {s.frames} frames, poses {s.truth}, extent {s.extent:.3g}"
            parts += [title, _runs_table(s), _not_registered(s)]
        parts += [
            picture(NAME, "trajectories", "Trajectories"),
            "## Memory over time",
            picture(NAME, "memory", "Memory over time"),
            self._memory(),
            "Bytes. The window holds the descriptors of the last keyframes, which every memory "
            "needs to triangulate. A learning map keeps sums of 16 bits; a sealed one has what "
            "stands under *at the end*. Medoids are counted alone, though the pipeline keeps all "
            "descriptors to choose them anew.",
            "## Time by stage",
            self._stages(),
            "## Drift of prototypes",
            "The pipeline adds observations to prototypes and subtracts them, merges and removes "
            "landmarks, frame by frame. A new map is built at once of the observations that were "
            "added and not subtracted. Sums are exact, so both files must have the same bytes. An "
            "observation that proves wrong after its descriptor was dropped (*dropped*) leaves the "
            "geometry but stays in the prototype, so some landmarks differ from those of a map of "
            "the frames' observations at the end. Counts above 255 halve a sum, which rounds.",
            self._drift(),
            "## Conditions",
            facts(self.conditions),
        ]
        if any(s.truth.startswith("SfM") and COLMAP in s.runs for s in self.sequences):
            parts.append(
                "Poses by SfM come from an incremental reconstruction with SIFT on the same "
                "images: there COLMAP is compared with its own method, and its error means little."
            )
        return parts

    def _beside(self) -> ReportTable:
        rows = []
        for s in self.sequences:
            ours, other = s.runs.get(PROTOTYPES), s.runs.get(TRADITIONAL)
            if ours is None or other is None:
                continue
            colmap, memory = s.runs.get(COLMAP), _memory_ratio(ours, other)
            registered = [str(ours.registered), str(other.registered)]
            registered.append("–" if colmap is None else str(colmap.registered))
            rows.append(
                [
                    s.name,
                    f"{s.frames}",
                    " : ".join(registered),
                    number(_error_ratio(ours), ".2f"),
                    "–" if memory is None else f"1/{1 / memory:.1f}",
                    number(_matching_ratio(ours, other), ".2f"),
                    "–" if ours.drift is None else "yes" if ours.drift.same_file else "no",
                ]
            )
        heads = ["sequence", "frames", "registered: ours, all, COLMAP", "trajectory error"]
        heads += ["memory", "matching time", "same bytes"]
        return ReportTable(heads, rows)

    def _memory(self) -> ReportTable:
        rows = [
            [
                s.name,
                run.label,
                *(
                    number(size, ",")
                    for size in (
                        run.memory_bytes,
                        run.peak_bytes,
                        run.peak_window_bytes,
                        run.learning_bytes,
                    )
                ),
            ]
            for s, run in self._runs()
            if run.memory_bytes is not None
        ]
        heads = ["sequence", "map of", "at the end", "peak", "peak with window", "learning map"]
        return ReportTable(heads, rows, words=2)

    def _stages(self) -> ReportTable:
        rows = [
            [
                s.name,
                run.label,
                ", ".join(f"{k} {1e3 * v / s.frames:.1f}" for k, v in run.seconds.items() if v),
                f"{run.wall_seconds:.0f}",
            ]
            for s, run in self._runs()
        ]
        heads = ["sequence", "map of", "CPU ms per frame", "seconds by the clock"]
        return ReportTable(heads, rows, words=3)

    def _drift(self) -> ReportTable:
        rows = []
        for s, run in self._runs():
            d = run.drift
            if d is None:
                continue
            counts = (d.landmarks, d.observations, d.different, d.halved, d.dropped)
            cells = [f"{count:,}" for count in (*counts, d.different_from_frames)]
            rows.append([s.name, run.label, "yes" if d.same_file else "**no**", *cells])
        heads = ["sequence", "map of", "same bytes", "landmarks", "observations", "different"]
        heads += ["over 255", "dropped", "different from the frames"]
        return ReportTable(heads, rows, words=3)


def _runs_table(s: MappedSequence) -> ReportTable:
    rows = []
    for run in s.runs.values():
        size = run.memory_bytes
        rows.append(
            [
                run.label,
                f"{run.registered} of {s.frames}",
                number(run.error, ".4g"),
                number(None if run.error is None else 100 * run.error / (s.extent or 1), ".2f"),
                f"{run.landmarks:,}",
                number(None if size is None else size / 1e3, ",.0f"),
                number(None if size is None else size / max(run.landmarks, 1), ".0f"),
                f"{1e3 * run.total / s.frames:.0f}",
                f"{1e3 * run.matching / s.frames:.0f}",
                number(run.search_ms, ".1f"),
                f"{run.error_pixels:.2f}",
            ]
        )
    heads = ["map of", "registered", "error", "% of extent", "landmarks", "KB"]
    heads += ["bytes per landmark", "ms per frame", "matching", "whole search", "pixels"]
    return ReportTable(heads, rows)


def _not_registered(s: MappedSequence) -> str:
    lines = [
        f"{run.label}: " + "; ".join(f"{n} × {why}" for why, n in run.not_registered.items())
        for run in s.runs.values()
        if run.not_registered
    ]
    return "Without a pose. " + ". ".join(lines) + "." if lines else ""


def _error_ratio(run: MappingRun) -> float | None:
    errors = run.common_errors
    return errors[0] / errors[1] if errors and errors[1] else None


def _memory_ratio(run: MappingRun, other: MappingRun) -> float | None:
    if run.memory_bytes is None or not other.memory_bytes:
        return None
    return run.memory_bytes / other.memory_bytes


def _matching_ratio(run: MappingRun, other: MappingRun) -> float | None:
    if run.memory == COLMAP or not other.matching:
        return None
    return run.matching / other.matching


def draw_ratios(results: MappingResults) -> Figure:
    """Draw frames, error, memory and matching time of each memory relative to all descriptors."""
    used = [s for s in results.sequences if TRADITIONAL in s.runs]
    memories = list(dict.fromkeys(memory for s in used for memory in s.runs))

    def ratio(s: MappedSequence, memory: str, which: str) -> float:
        run, other = s.runs.get(memory), s.runs[TRADITIONAL]
        if run is None:
            return float("nan")
        found = {
            "registered frames": run.registered / max(other.registered, 1),
            "trajectory error": _error_ratio(run),
            "descriptor memory": _memory_ratio(run, other),
            "matching time": _matching_ratio(run, other),
        }[which]
        return float("nan") if found is None else found

    panels = []
    for which in ("registered frames", "trajectory error", "descriptor memory", "matching time"):
        series = [
            plot.Series(
                LABELS.get(memory, memory),
                (),
                [ratio(s, memory, which) for s in used],
                _COLORS.get(memory, plot.MUTED),
            )
            for memory in memories
        ]
        ticks = {float(i): s.name for i, s in enumerate(used)}
        top = 3 if which == "trajectory error" else None
        title, levels = f"{which}, all descriptors = 1", [(1.0, "", plot.INK)]
        panels.append(plot.Panel(title, "", "", series, ticks, levels=levels, bottom=0, top=top))
    return plot.draw_bars(panels)


def draw_trajectories(results: MappingResults) -> Figure:
    """Draw the aligned camera centres of all memories and the true ones, from above."""
    from protomark_bench.trajectory import trajectory_error

    panels = []
    for s in results.sequences:
        plane = np.array(s.plane)
        middle = np.mean(list(s.true_centers.values()), axis=0)

        def flat(
            points: NDArray[np.float64],
            plane: NDArray[np.float64] = plane,
            middle: NDArray[np.float64] = middle,
        ) -> NDArray[np.float64]:
            return np.asarray((points - middle) @ plane.T).T

        x, y = flat(np.array(list(s.true_centers.values())))
        series = [plot.Series("true", x, y, "#c3c9d3", "-", 5)]
        for memory, run in s.runs.items():
            names = [n for n in s.true_centers if n in run.centers]
            estimated = np.array([run.centers[n] for n in names])
            try:
                found = trajectory_error(estimated, np.array([s.true_centers[n] for n in names]))
            except ValueError:
                continue
            x, y = flat(found.alignment(estimated))
            style = "--" if memory == COLMAP else "-"
            width = 1.8 if memory == PROTOTYPES else 1
            color = _COLORS.get(memory, plot.MUTED)
            series.append(plot.Series(run.label, x, y, color, style, width))
        title = f"{s.name}, {s.frames} frames"
        panels.append(plot.Panel(title, "", "", series, square=True))
    return plot.draw_lines(panels, height=3.4)


def draw_memory(results: MappingResults) -> Figure:
    """Draw the bytes of each map after each frame, without the window."""
    panels = []
    for s in results.sequences:
        series = [
            plot.Series(
                run.label,
                range(len(run.growth)),
                [size / 1e6 for size in run.growth],
                _COLORS.get(memory, plot.MUTED),
                "-",
                1.8 if memory == PROTOTYPES else 1.3,
            )
            for memory, run in s.runs.items()
            if run.growth
        ]
        panels.append(plot.Panel(s.name, "frame", "MB", series, bottom=0))
    return plot.draw_lines(panels, height=2.6)
