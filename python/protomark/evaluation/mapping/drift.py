"""Whether a map made step by step is the one made at once: sums are exact, so it should be."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.evaluation.mapping.ledger import Ledger
from protomark.evaluation.mapping.results import Drift
from protomark.mapping.mapper import Mapper
from protomark.mapping.source import Folder
from protomark.tracks.features import Extractor

# Observations that a prototype counts before it is halved.
_MOST = 255


def drift(mapper: Mapper, ledger: Ledger, source: Folder) -> Drift:
    """Make the map of prototypes anew, at once, and compare.

    The pipeline added and took back observations frame by frame, merged and discarded landmarks.
    One map is made of the observations that were added and not taken back; another one from the
    images, of what the frames see at the end.
    """
    made = ledger.map
    ids, codes = ledger.held()
    fresh = pm.PrototypeMap(ledger.encoder, ledger.dim)
    fresh.add_codes(ids, codes)
    seen, descriptors = _final(mapper, source)
    again = pm.PrototypeMap(ledger.encoder, ledger.dim)
    again.add(seen, descriptors)
    return Drift(
        landmarks=len(made),
        observations=len(ids),
        same_file=_saved(made) == _saved(fresh),
        unlike=_unlike(made, fresh),
        dropped=len(ids) - len(seen),
        unlike_frames=_unlike(made, again),
        forgetful=int((np.unique(ids, return_counts=True)[1] > _MOST).sum()),
    )


def _unlike(one: pm.PrototypeMap, other: pm.PrototypeMap) -> int:
    """Landmarks that only one map has, or whose count or prototype differs."""
    both = np.intersect1d(one.ids, other.ids)
    off = one.counts(both) != other.counts(both)
    off |= (one.prototype(both) != other.prototype(both)).any(axis=1)
    return int(off.sum()) + len(one) + len(other) - 2 * len(both)


def _final(mapper: Mapper, source: Folder) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Landmark and descriptor of everything that the frames see at the end."""
    extractor = Extractor(mapper.settings.descriptor, mapper.settings.max_keypoints)
    frames = {frame.name: frame for frame in mapper.structure.frames}
    ids, descriptors = [np.zeros(0, np.int64)], [np.zeros((0, mapper.width), np.uint8)]
    for picture in source.pictures(only=set(frames)):
        assert picture.image is not None
        frame = frames[picture.name]
        features = extractor(picture.image)
        # Keypoints of one image never share a place (`features.MIN_DISTANCE`).
        at = {place.tobytes(): row for row, place in enumerate(features.keypoints)}
        rows = [at[place.tobytes()] for place in frame.keypoints[frame.observed]]
        ids.append(frame.seen)
        descriptors.append(features.descriptors[rows])
    return np.concatenate(ids), np.concatenate(descriptors)


def _saved(scene: pm.PrototypeMap) -> bytes:
    with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
        path = Path(folder) / "scene.pmk"
        scene.save(path)
        return path.read_bytes()
