"""Observations: which descriptor of which keyframe saw which landmark."""

from protomark.tracks.file import Tracks

__all__ = ["Tracks"]
