"""Keypoints and binary descriptors of images."""
