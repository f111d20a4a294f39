"""Incremental structure from motion whose map keeps prototypes in place of descriptors."""
