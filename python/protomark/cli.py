"""The `protomark` command."""

from __future__ import annotations

import typer

app = typer.Typer(
    help="One small integer prototype per landmark instead of all its binary descriptors.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Run the command; an expected error becomes one sentence on stderr and exit code 1."""
    from protomark.console import progress_console

    try:
        app()
    except (ValueError, OSError, KeyError, ModuleNotFoundError) as error:
        text = error.args[0] if isinstance(error, KeyError) and error.args else error
        progress_console.print(f"[bold red]error:[/] {text}", highlight=False, soft_wrap=True)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
