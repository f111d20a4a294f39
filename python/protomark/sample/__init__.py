"""One small real map, so that everything runs after install."""
