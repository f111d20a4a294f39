"""`protomark evaluate-mapping`: `protomark map` with several memories, beside COLMAP."""
