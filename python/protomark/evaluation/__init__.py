"""Evaluates methods by the protocol of the paper."""
