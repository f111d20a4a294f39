"""Serves a map over HTTP: an image or features go in, a pose comes out."""
