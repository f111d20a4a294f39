"""Commands of other distributions: entry points of the group `protomark.commands`.

The name of an entry point is the command's, its value a function as Typer takes them. It is loaded
when `--help` lists it or when the command is called, so its module should import little.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any

import typer
from typer.core import TyperGroup

GROUP = "protomark.commands"


class CommandGroup(TyperGroup):
    """The commands of `protomark`, its own first."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names in the order in which `--help` lists them."""
        own = super().list_commands(ctx)
        return own + [name for name in _found() if name not in own]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of this name, None if there is none."""
        own = super().get_command(ctx, cmd_name)
        if own is not None or cmd_name not in (found := _found()):
            return own
        app = typer.Typer(
            add_completion=False,
            pretty_exceptions_enable=False,
            context_settings={"help_option_names": ["-h", "--help"]},
        )
        app.command(cmd_name)(_loaded(found[cmd_name]))
        return typer.main.get_command(app)


def _loaded(entry: EntryPoint) -> Any:
    """The function of an entry point, or one that fails when it is called: help goes on."""
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
