"""What the figures say: sentences made from the numbers, the unwelcome ones too."""

from __future__ import annotations

from protomark.evaluation.mapping.results import Results, Run, SequenceResult
from protomark.evaluation.mapping.targets import MAX_ERROR, matching
from protomark.evaluation.mapping.variants import COLMAP, LABELS, PROTOTYPES, TRADITIONAL


def reading(results: Results) -> list[str]:
    """One paragraph a finding, in Markdown."""
    found = [_verdict(results)]
    pairs = [
        (s, s.runs[PROTOTYPES], s.runs[TRADITIONAL])
        for s in results.sequences
        if PROTOTYPES in s.runs and TRADITIONAL in s.runs
    ]
    if pairs:
        found += [_registered(pairs), _errors(pairs), _memory(pairs), _time(pairs)]
    found += [
        text
        for text in (_beside_colmap(results), _lost(results), _wrong(results), _drift(results))
        if text
    ]
    return found


def _verdict(results: Results) -> str:
    met = [t.name for t in results.targets if t.met]
    missed = [t.name for t in results.targets if t.met is False]
    open_ = [t.name for t in results.targets if t.met is None]
    parts = [f"**Targets** met on every sequence of this run: {', '.join(met) or 'none'}"]
    if missed:
        where = [
            f"{t.name} ({', '.join(n for n, (_, fine) in t.measured.items() if fine is False)})"
            for t in results.targets
            if t.met is False
        ]
        parts.append(f"not met: {', '.join(where)}")
    if open_:
        parts.append(f"not measured: {', '.join(open_)}")
    return "; ".join(parts) + "."


_Pairs = list[tuple[SequenceResult, Run, Run]]


def _registered(pairs: _Pairs) -> str:
    ours, theirs = sum(p.registered for _, p, _ in pairs), sum(t.registered for _, _, t in pairs)
    frames = sum(s.frames for s, _, _ in pairs)
    fewer = [s.name for s, p, t in pairs if p.registered < t.registered]
    text = f"**Frames.** Prototypes register {ours} of {frames} frames, all descriptors {theirs}"
    return text + (f"; prototypes fewer on {', '.join(fewer)}." if fewer else ".")


def _errors(pairs: _Pairs) -> str:
    ratios = {}
    for s, _, _ in pairs:
        ours, theirs = s.error(PROTOTYPES, TRADITIONAL), s.error(TRADITIONAL, PROTOTYPES)
        if ours is not None and theirs:
            ratios[s.name] = ours / theirs
    if not ratios:
        return "**Trajectory error.** No sequence has enough frames that both register."
    better = [n for n, r in ratios.items() if r <= 1]
    worse = {n: r for n, r in ratios.items() if r > MAX_ERROR}
    text = (
        "**Trajectory error**, on frames that both register: prototypes are as good or better on "
        f"{len(better)} of {len(ratios)} sequences"
    )
    if worse:
        listed = ", ".join(f"{n} ({r:.2f} times)" for n, r in worse.items())
        text += f", and more than 5 % worse on {listed}"
    return text + (
        ". Single runs: a ratio near 1 is within what another choice of frames would change."
    )


def _memory(pairs: _Pairs) -> str:
    shares, peaks, opens = [], [], []
    for _, p, t in pairs:
        if p.memory_bytes and t.memory_bytes and p.peak_window_bytes and t.peak_window_bytes:
            shares.append(t.memory_bytes / p.memory_bytes)
            peaks.append(t.peak_window_bytes / p.peak_window_bytes)
            opens.append(t.memory_bytes / (p.open_bytes or p.memory_bytes))
    if not shares:
        return "**Memory.** No map was made."
    return (
        f"**Memory.** At the end all descriptors take {_range(shares, 1)} times "
        f"the bytes of sealed prototypes ({_range(opens, 1)} times those of the "
        "open map that the pipeline itself works on). While mapping, the window of both is counted "
        f"too, and at the peak the ratio is only {_range(peaks, 1)}: the shorter "
        "a sequence, the more the window weighs."
    )


def _time(pairs: _Pairs) -> str:
    used = [(s, p, t) for s, p, t in pairs if t.registered and matching(t.seconds) > 0]
    if not used:
        return "**Time.** No map was made."
    match = [matching(p.seconds) / matching(t.seconds) for _, p, t in used]
    search = [t.search_ms / p.search_ms for _, p, t in used if p.search_ms and t.search_ms]
    whole = [p.total / t.total for _, p, t in used]
    text = (
        f"**Time.** Finding a frame in the map takes {_range(match, 2)} of the "
        "time with all descriptors; this counts the start of a map, RANSAC and the refinement of "
        "poses, and most frames are sought near a predicted pose only"
    )
    if search:
        text += f". The search of the whole map (a lost frame) is {_range(search, 1)} times as fast"
    return text + f". The whole pipeline takes {_range(whole, 2)} of the time."


def _beside_colmap(results: Results) -> str:
    used = [s for s in results.sequences if COLMAP in s.runs and PROTOTYPES in s.runs]
    if not used:
        return ""
    ours = sum(s.runs[PROTOTYPES].registered for s in used)
    theirs = sum(s.runs[COLMAP].registered for s in used)
    time = [s.runs[COLMAP].total / s.runs[PROTOTYPES].total for s in used]
    errors = []
    for s in used:
        one, other = s.error(PROTOTYPES, COLMAP), s.error(COLMAP, PROTOTYPES)
        if one is not None and other:
            errors.append(f"{s.name} {one / other:.1f}")
    text = (
        f"**COLMAP** registers {theirs} frames where prototypes register {ours}, in "
        f"{_range(time, 1)} times the CPU time"
    )
    if errors:
        text += (
            ". Trajectory error of prototypes over COLMAP's, on frames that both register: "
            + ", ".join(errors)
        )
    return text + "."


def _lost(results: Results) -> str:
    weak = [
        f"{s.name} with {LABELS.get(run.variant, run.variant)} ({run.registered} of {s.frames})"
        for s in results.sequences
        for run in s.runs.values()
        if run.registered < 0.9 * s.frames
    ]
    return f"**Fewer than 90 % of the frames** are registered on {', '.join(weak)}." if weak else ""


def _wrong(results: Results) -> str:
    found = {}
    for s in results.sequences:
        shares = {v: (s.error(v) or 0.0) / s.extent for v in s.runs if s.extent}
        bad = [
            f"{LABELS.get(v, v)} {100 * share:.0f} %" for v, share in shares.items() if share > 0.05
        ]
        if bad:
            found[s.name] = f"{s.name} (extent {s.extent:.2g}; {', '.join(bad)})"
    if not found:
        return ""
    return (
        "**Trajectories that are not right**, with an error above 5 % of the extent of the true "
        f"one: {'; '.join(found.values())}. There ratios between variants say little."
    )


def _drift(results: Results) -> str:
    drifts = [
        (s.name, run) for s in results.sequences for run in s.runs.values() if run.drift is not None
    ]
    if not drifts:
        return ""
    apart = [
        f"{name} with {LABELS.get(run.variant, run.variant)} ({run.drift.unlike} of "
        f"{run.drift.landmarks} landmarks; {run.drift.forgetful} were seen more than 255 times and "
        "halved)"
        for name, run in drifts
        if run.drift and not run.drift.same_file
    ]
    dropped = sum(run.drift.dropped for _, run in drifts if run.drift)
    held = sum(run.drift.observations for _, run in drifts if run.drift)
    text = (
        f"**Drift.** Not the same bytes: {'; '.join(apart)}"
        if apart
        else f"**Drift.** All maps of prototypes ({len(drifts)}) are saved in the very bytes of a "
        "map made at once of the observations that were put into them"
    )
    return text + (
        f". {100 * dropped / max(held, 1):.2f} % of these observations were found wrong "
        "after their descriptors were gone: the geometry has dropped them, the prototypes have not."
    )


def _range(values: list[float], digits: int) -> str:
    """From the least to the largest."""
    low, high = (f"{f(values):.{digits}f}" for f in (min, max))
    return low if low == high else f"{low} to {high}"
