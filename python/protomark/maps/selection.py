"""Which landmarks to keep where a map has to be smaller: those that cover its images, or its space.

Every landmark falls into *bins*: each image that saw it, the quarter of the image, and the
sixteenth, as in the visibility pyramid by which COLMAP judges how well points cover an image
(Schoenberger and Frahm, Structure-from-Motion Revisited, CVPR 2016). A landmark in a bin that
holds c chosen ones already is worth 1 / (1 + c) there, so that each image keeps enough landmarks,
spread over it, before any gets many (Li, Snavely and Huttenlocher, Location Recognition using
Prioritized Feature Matching, ECCV 2010; Cao and Snavely, Minimal Scene Descriptions from Structure
from Motion Models, CVPR 2014). What many images saw is worth more than what few did. The greedy
choice is an order, so that smaller maps hold parts of larger ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.geometry.colmap import find_model, read_observations
from protomark.tracks.file import Tracks

# Cells along each side of an image, or of the map's box.
_IMAGE_LEVELS = (1, 2, 4)
_SPACE_LEVELS = (4, 8, 16, 32)
# A round chooses this share of what was chosen before: one at a time would take hours.
_ROUND = 0.1
_FIRST_ROUND = 8


@dataclass(frozen=True)
class Views:
    """Which bins the landmarks of a map fall into; a pair per landmark and bin."""

    ids: NDArray[np.int64]  # (v,) int64, landmark ids
    bins: NDArray[np.int64]  # (v,) int64, from 0 on

    @classmethod
    def of_images(
        cls,
        ids: NDArray[np.int64],  # (o,) int64, landmark of each observation
        images: NDArray[np.int64],  # (o,) int64, which image it is in, from 0 on
        pixels: NDArray[np.floating],  # (o, 2), where in the image
        sizes: NDArray[np.floating],  # (o, 2), width and height of the image
    ) -> Views:
        """The bins of observations."""
        at = np.clip(pixels / sizes, 0, np.nextafter(1, 0))
        return cls._of_grid(ids, images, at, _IMAGE_LEVELS)

    @classmethod
    def of_tracks(cls, tracks: Tracks) -> Views:
        """The bins of the observations of tracks."""
        rows = tracks.observations
        keyframes = tracks.keyframe_of_keypoint[rows]
        cameras = [tracks.cameras[int(i)] for i in tracks.keyframe_camera]
        sizes = np.array([(c.width, c.height) for c in cameras], np.float64)
        return cls.of_images(
            tracks.landmark_of_keypoint[rows], keyframes, tracks.keypoints[rows], sizes[keyframes]
        )

    @classmethod
    def of_model(cls, folder: Path) -> Views:
        """The bins of the observations of a COLMAP model whose point ids are landmark ids."""
        return cls.of_images(*read_observations(find_model(folder)))

    @classmethod
    def of_space(cls, scene: pm.PrototypeMap) -> Views:
        """The bins of landmarks in the box of all, where nobody knows which image saw them.

        Landmarks without position fall into one bin.
        """
        ids = scene.ids
        positions = scene.positions(ids)
        placed: NDArray[np.bool_] = np.asarray(np.isfinite(positions).all(axis=1))
        # A few landmarks far away must not make the cells large.
        low, high = np.nanpercentile(positions, (1, 99), axis=0) if placed.any() else (0.0, 1.0)
        size = max(float(np.max(high - low)), np.finfo(np.float64).tiny)
        at = np.clip((np.where(placed[:, None], positions, low) - low) / size, 0, 1 - 1e-9)
        return cls._of_grid(ids, placed.astype(np.int64), at, _SPACE_LEVELS)

    @classmethod
    def _of_grid(
        cls,
        ids: NDArray[np.int64],
        groups: NDArray[np.int64],
        at: NDArray[np.floating],
        levels: tuple[int, ...],
    ) -> Views:
        """The cells, at several levels, of points `at` (o, d) in [0, 1) within their groups."""
        bins, first = [], 0
        for cells in levels:
            cell = groups
            for axis in (at * cells).astype(np.int64).T:
                cell = cell * cells + axis
            _, numbered = np.unique(cell, return_inverse=True)
            bins.append(first + numbered.reshape(-1))
            first += int(numbered.max(initial=-1)) + 1
        return cls(np.tile(ids, len(levels)), np.concatenate(bins))


def select_landmarks(
    ids: NDArray[np.int64], views: Views, count: int, counts: NDArray[np.integer] | None = None
) -> NDArray[np.int64]:
    """The most useful landmarks, the most useful first.

    Args:
        ids: (l,) int64, ascending: all landmarks.
        views: the bins of these; those of other landmarks are passed over.
        count: how many to choose, at most l.
        counts: (l,) observations of each, where `views` do not tell: twice as many views are worth
            one bin more; None: `views` tell.

    Returns:
        (count,) int64.
    """
    index = np.searchsorted(ids, views.ids)
    present = np.isin(views.ids, ids)
    landmark, bins = index[present], views.bins[present]
    by_landmark = np.argsort(landmark, kind="stable")
    landmark, bins = landmark[by_landmark], bins[by_landmark]
    chosen_in = np.zeros(bins.max(initial=-1) + 1, np.int64)
    weight = np.ones(len(ids)) if counts is None else np.log2(1.0 + counts)
    chosen = np.zeros(len(ids), bool)
    order: list[NDArray[np.int64]] = []
    done = 0
    while done < count:
        worth = weight * np.bincount(landmark, 1 / (1 + chosen_in[bins]), len(ids))
        worth[chosen] = -1
        n = min(count - done, max(_FIRST_ROUND, int(_ROUND * done)))
        best = np.argsort(-worth, kind="stable")[:n]
        order.append(best)
        chosen[best] = True
        done += n
        is_best = np.zeros(len(ids), bool)
        is_best[best] = True
        chosen_in += np.bincount(bins[is_best[landmark]], minlength=len(chosen_in))
    return ids[np.concatenate(order)] if order else ids[:0]
