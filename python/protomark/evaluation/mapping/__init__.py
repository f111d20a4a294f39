"""The incremental pipeline on whole sequences, with several memories, beside COLMAP."""
