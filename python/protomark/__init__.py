"""Protomark: one small integer prototype per landmark instead of all its binary descriptors."""
