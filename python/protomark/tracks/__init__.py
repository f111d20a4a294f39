"""Observations: which descriptor of which keyframe saw which landmark."""

from protomark.tracks.file import Camera, Tracks

__all__ = ["Camera", "Tracks"]
