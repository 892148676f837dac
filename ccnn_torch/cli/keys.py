"""`ccnn keys`: every key that a config may have."""

from __future__ import annotations

import json
from enum import StrEnum
from typing import Annotated

import typer


class Command(StrEnum):
    """The commands that take a config."""

    run = "run"
    identify = "identify"
    suite = "suite"
    plan = "plan"
    diagnose = "diagnose"


def keys(
    command: Annotated[Command, typer.Argument(help="The command whose config it is.")] = Command.run,
    schema: Annotated[bool, typer.Option("--schema", help="A JSON Schema for editors instead of a list.")] = False,
) -> None:
    """List every config key with its default and what it means, section by section; or write a JSON Schema of them.

    An editor that knows YAML completes and checks keys by the schema: put the line
    "# yaml-language-server: $schema=ccnn.schema.json" on top of a config.

    Examples:

    ccnn keys

    ccnn keys identify

    ccnn keys --schema > ccnn.schema.json
    """
    from ccnn_torch.config.commands import config_schema, keys_by_section

    if schema:
        typer.echo(json.dumps(config_schema(command.value), indent=2, ensure_ascii=False))
        return
    for section, entries in keys_by_section(command.value).items():
        typer.echo(f"\n# {section}" if section else "# top level")
        for key, default, description in entries:
            typer.echo(f"{key}={default}\n    {description}")
