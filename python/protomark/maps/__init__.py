"""Map files: built from tracks, merged, split and described."""
