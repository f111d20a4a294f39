"""Tracks: observations of landmarks by the descriptors of keyframes."""

from protomark.tracks.file import Tracks

__all__ = ["Tracks"]
