"""Cameras, poses, COLMAP models and the estimation of poses, with COLMAP's conventions."""
