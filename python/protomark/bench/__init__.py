"""Protomark's speed, its peers' and the machine's ceilings, in one run."""
