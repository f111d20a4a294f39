"""`protomark bench`: speed beside peers and beside the machine's ceilings, in one run."""
