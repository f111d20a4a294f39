"""The protocol of the paper, its baselines, and reports."""
