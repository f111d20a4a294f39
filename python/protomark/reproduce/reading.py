"""What the figures say, beside what the paper says: sentences made from the numbers."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np

from protomark.reproduce.paper import PRECISION_BY_DIM, TABLE, TRAINING_DESCRIPTORS
from protomark.reproduce.results import DepthPoint, Results, best
from protomark.reproduce.training import LAYERS, OBJECTIVES, PAPER_PICK, SHAPES
from protomark.reproduce.triplet import MARGIN

# Below this share of the margin, the triplets count as solved.
_SOLVED = 0.1


def reading(results: Results) -> list[str]:
    """One paragraph a finding, in Markdown."""
    return [
        _winner(results),
        _objectives(results),
        _depth(results),
        _shapes(results),
        _dimensions(results),
        _order(results),
        *_shipped(results),
    ]


def reasons(results: Results) -> list[str]:
    """What is unlike the paper here, so what may explain a difference, in Markdown."""
    facts = [s for s in results.sequences if s.role == "training"]
    seen = sum(s.observations for s in facts)
    listed = [
        f"**Data.** {seen:,} training descriptors of "
        f"{', '.join(s.name for s in facts)}, where the paper has {TRAINING_DESCRIPTORS} of one "
        "sequence. The paper's training, validation and test sequences come "
        "from one device, a Google Tango tablet; here camera, scene and motion change from one "
        "sequence to the next.",
        _length(results),
        *_easy_negatives(results),
        "**What the paper leaves open** was chosen once and not tuned: margin 1, 512 triplets or "
        "320 classes with up to 6 views each in a step (about as many descriptors for either "
        "objective), a third of the views as queries, squared Euclidean distance for the "
        "prototypical networks as Snell et al. have it, batches of one sequence, weights kept at "
        "the lowest validation loss.",
        "**Chance.** The sweeps have one seed. In the table, training seed and split together move "
        f"the paper's 16-d prototypes by ±{results.row('prototypes-16').spread:.3f} (one standard "
        "deviation), their share of the unaggregated precision by "
        f"±{results.ratio_spread(results.row('prototypes-16')):.3f}; differences of that size "
        "between networks say nothing.",
        "**Tracks.** Ours are made by matching the same descriptor, with a ratio test, so "
        "observations that are very unlike the rest of their track are missing. The principal "
        "components are fitted on the support of each test sequence; the paper does not say what "
        "its were fitted on.",
    ]
    return listed


def _winner(results: Results) -> str:
    winner, pick = results.winner, results.paper_pick
    above = sum(p.precision > pick.precision for p in results.networks)
    if winner.training == PAPER_PICK:
        return (
            f"**Best network** on validation: {_name(winner)} with {winner.precision:.3f}, "
            "the paper's choice."
        )
    return (
        f"**Best network** on validation: {_name(winner)} with {winner.precision:.3f}. The "
        f"paper's choice, {_name(pick)}, has {pick.precision:.3f} and is number "
        f"{above + 1} of {len(results.networks)}."
    )


def _objectives(results: Results) -> str:
    pairs = [
        (results.point("triplet", shape, n), results.point("prototypical", shape, n))
        for shape in SHAPES
        for n in LAYERS
        if not (shape == "fat" and n == 2)
    ]
    ahead = sum(t.precision > p.precision for t, p in pairs)
    mean = float(np.mean([t.precision - p.precision for t, p in pairs]))
    text = (
        f"**Triplet against prototypical.** Triplet networks are ahead in {ahead} of {len(pairs)} "
        f"pairs that differ in nothing else, by {mean:+.3f} on average. The paper finds them ahead "
        "consistently, to its authors' surprise: they had expected the prototypical loss to win, "
        "as it models the search among prototypes itself. "
    )
    if ahead == len(pairs):
        return text + "We find the same as they."
    if ahead == 0:
        return text + "We find what they had expected, not what they found."
    return text + "Here neither wins throughout."


def _depth(results: Results) -> str:
    tops = []
    for objective in OBJECTIVES:
        for shape in SHAPES:
            top = best([results.point(objective, shape, n) for n in LAYERS])
            tops.append((f"{shape}, {objective}", top.training.layers))
    listed = "; ".join(f"{name}: {layers}" for name, layers in tops)
    agree = sum(layers == PAPER_PICK.layers for _, layers in tops)
    return (
        f"**Depth.** Best number of layers: {listed}. The paper finds three layers best; so do "
        f"{agree} of our {len(tops)} combinations."
    )


def _shapes(results: Results) -> str:
    gaps = {
        objective: float(
            np.mean(
                [
                    results.point(objective, "fat", n).precision
                    - results.point(objective, "funnel", n).precision
                    for n in LAYERS[1:]
                ]
            )
        )
        for objective in OBJECTIVES
    }
    text = ", ".join(f"{gap:+.3f} with the {name} loss" for name, gap in gaps.items())
    similar = abs(gaps["triplet"]) <= 0.01
    return (
        f"**Fat against funnel.** Fat networks of three to five layers differ from funnels by "
        f"{text} (mean over depths). The paper calls the two very similar with the triplet loss; "
        + ("so they are here." if similar else "here they are not.")
    )


def _dimensions(results: Results) -> str:
    whole = results.curves_unaggregated
    dims = list(PRECISION_BY_DIM)
    theirs = ", ".join(
        f"{PRECISION_BY_DIM[b] - PRECISION_BY_DIM[a]:+.2f}" for a, b in pairwise(dims)
    )
    parts = []
    for curve in results.curves:
        steps = ", ".join(f"{curve.mean(b) - curve.mean(a):+.3f}" for a, b in pairwise(dims))
        parts.append(
            f"{curve.training.label}: {steps}, ending at {curve.mean(dims[-1]) / whole:.3f} of the "
            f"unaggregated precision with {dims[-1]}"
        )
    end = PRECISION_BY_DIM[dims[-1]] / TABLE["unaggregated"]
    return (
        f"**Dimension.** What each doubling from {dims[0]} to {dims[-1]} brings: "
        + "; ".join(parts)
        + f". The paper: {theirs}, ending at {end:.3f}."
    )


def _order(results: Results) -> str:
    names = sorted(TABLE, key=lambda name: -TABLE[name])
    mean = {name: results.row(name).mean for name in names}
    label = {name: _lower(results.row(name).label) for name in names}
    ours = sorted(names, key=lambda name: -mean[name])
    listed = " > ".join(f"{label[name]} ({mean[name]:.3f})" for name in ours)
    text = f"**Order in the table.** Ours: {listed}. "
    swapped = [(a, b) for a, b in combinations(names, 2) if mean[a] < mean[b]]
    if not swapped:
        return text + "It is the paper's order."
    parts = []
    for higher, lower in swapped:
        one, other = results.row(higher), results.row(lower)
        where = sum(
            np.mean(other.precision[name]) > np.mean(one.precision[name]) for name in one.precision
        )
        always = all(b > a for a, b in zip(one.by_seed, other.by_seed, strict=True))
        parts.append(
            f"{label[lower]} is above {label[higher]} by "
            f"{mean[lower] - mean[higher]:.3f} (on {where} of {len(one.precision)} sequences"
            + ("" if always else ", not at every seed")
            + f"; in the paper it is {TABLE[higher] - TABLE[lower]:.3f} below)"
        )
    return text + "Unlike the paper: " + "; ".join(parts) + "."


def _shipped(results: Results) -> list[str]:
    parts = []
    for dim in (16, 32):
        rows = {row.name: row for row in results.rows}
        mine, theirs = rows.get(f"protomark-{dim}"), rows[f"prototypes-{dim}"]
        if mine is not None:
            parts.append(
                f"at {dim} numbers it has {mine.mean:.3f} in {mine.bytes_per_landmark:.0f} bytes "
                f"where the paper's network trained here has {theirs.mean:.3f} in "
                f"{theirs.bytes_per_landmark:.0f}"
            )
    if not parts:
        return []
    return [
        "**The encoder that ships** is not the paper's: network, loss and training are others (see "
        "its card). On the same queries, " + "; ".join(parts) + "."
    ]


def _length(results: Results) -> str:
    improving = sum(point.was_improving for point in results.networks)
    steps = [point.steps for point in results.networks]
    if results.max_steps is None:
        return (
            f"**Length.** The plateaus ended every training, after {min(steps):,} to "
            f"{max(steps):,} steps."
        )
    text = (
        f"**Length.** Trainings ended after {results.max_steps:,} steps at the latest; "
        f"{improving} of {len(results.networks)} had their lowest validation loss at the very end"
    )
    if not improving:
        return text + "."
    return text + ", so they were still learning: what learns slowly is judged too low by that."


def _easy_negatives(results: Results) -> list[str]:
    loss = results.paper_pick.validation_loss
    if loss > _SOLVED * MARGIN:
        return []
    return [
        f"**Random negatives.** The paper's choice reaches a validation loss of {loss:.3f} where "
        f"the margin is {MARGIN:g}: a landmark drawn at random is seldom one that is mistaken for "
        "another, so triplets leave little to learn. The prototypical loss compares a query with "
        "all landmarks of its episode, the hard ones among them."
    ]


def _lower(label: str) -> str:
    return label[0].lower() + label[1:]


def _name(point: DepthPoint) -> str:
    widths = "-".join(str(units) for units in (*point.hidden, point.training.dim))
    return f"{point.training.label} ({widths})"
