"""The paper's whole evaluation, run again on other sequences (`protomark reproduce`)."""
