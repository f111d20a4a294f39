"""Incremental structure from motion with prototypes in place of descriptors."""
