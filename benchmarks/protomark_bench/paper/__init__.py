"""`protomark reproduce`: the evaluation of Komorowski and Trzciński's paper, on other sequences."""
