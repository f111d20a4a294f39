"""Trains encoders from tracks with PyTorch (the extra `train`)."""
