"""The encoders that ship."""
