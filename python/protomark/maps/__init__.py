"""Builds, merges, splits, opens and describes map files."""
