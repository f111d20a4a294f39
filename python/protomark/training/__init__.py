"""Training encoders from tracks (PyTorch, `pip install protomark[train]`)."""
