"""What maps keep of a landmark's descriptors without Protomark: the methods to compare with."""
