"""Measures Protomark: its speed beside peers, the paper's evaluation, and mapping beside COLMAP."""
