"""The parts of exported files that are the same for every model: templates of Jinja in `templates/`."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment


def filled(template: str, **values: Any) -> str:
    """A file's text; a name in the template that no value has is an error."""
    return _environment().get_template(template).render(**values)


@cache
def _environment() -> Environment:
    # Loaded with the package by everybody who compensates, and needed by who exports alone.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("ccnn_torch.compensation.targets"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
