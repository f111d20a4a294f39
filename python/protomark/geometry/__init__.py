"""Cameras, poses, COLMAP models and the estimation of poses. Conventions are COLMAP's."""
