"""The `protomark` command, as a script and as `python -m protomark`."""

from __future__ import annotations


def main() -> None:
    """Run the command, or tell how to install what it needs."""
    try:
        from protomark.cli import main as run
    except ModuleNotFoundError as error:
        from protomark.extras import missing

        if error.name not in ("typer", "rich"):
            raise
        raise SystemExit(f"error: {missing(error.name)}") from None
    run()


if __name__ == "__main__":
    main()
