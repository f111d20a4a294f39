"""`python -m protomark.cli`."""

from protomark.cli import main

main()
