"""Builds maps on many machines, by Ray."""

from protomark.distributed.build import build as build
