"""Commands of other distributions: entry points of the group `protomark.commands`.

The name of an entry point is that of the command, and its value is a function for Typer. The
function is loaded when `--help` lists the command or when it is called, so its module should import
little.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any

import typer
from typer.core import TyperGroup

GROUP = "protomark.commands"


class CommandGroup(TyperGroup):
    """The commands of `protomark`, followed by those of other distributions."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names in the order in which `--help` lists them."""
        names = super().list_commands(ctx)
        return names + [name for name in _found() if name not in names]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of this name, None if there is none."""
        command = super().get_command(ctx, cmd_name)
        if command is not None or cmd_name not in (found := _found()):
            return command
        app = typer.Typer(
            add_completion=False,
            pretty_exceptions_enable=False,
            context_settings={"help_option_names": ["-h", "--help"]},
        )
        app.command(cmd_name)(_loaded(found[cmd_name]))
        return typer.main.get_command(app)


def _loaded(entry: EntryPoint) -> Any:
    """The function of an entry point; if loading fails, one that raises when it is called."""
    try:
        return entry.load()
    except (ImportError, AttributeError) as error:
        reason = f"the command {entry.name} of another distribution cannot be loaded: {error}"

        def broken() -> None:
            raise ModuleNotFoundError(reason)

        broken.__doc__ = f"({reason})"
        return broken


def _found() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}
