"""`ccnn keys`: every key that a config may have."""

from __future__ import annotations

import typer

__all__ = ["keys"]


def keys() -> None:
    """List every config key with its default and what it means.

    Example:

    ccnn keys | grep ccnn.
    """
    from ccnn_torch.runs import describe_keys

    for key, default, description in describe_keys():
        typer.echo(f"{key}={default}\n    {description}")
