"""Other ways to keep a landmark's descriptors, to compare Protomark with."""
