"""The entries, and those of a user's own: path/to/file.py:NAME, a function fit(rows) or an `Entry`."""

from __future__ import annotations

from benchmarks.field import geometry, learners, ours
from benchmarks.field.protocol import Entry
from ccnn_torch.errors import InputError
from ccnn_torch.plugins import load_plugin

ENTRIES = {
    "nominal": Entry(geometry.nominal, "the maker's geometry, base and tool frames fitted"),
    "scipy_geometry": Entry(
        geometry.scipy_geometry, "least squares on Denavit-Hartenberg parameters", geometry.links_changed
    ),
    "geometry_gp": Entry(learners.geometry_gp, "the same, and a Gaussian process of scikit-learn on the remainder"),
    "geometry_trees": Entry(learners.geometry_trees, "the same, and 400 extra trees of scikit-learn on the remainder"),
    "mukca": Entry(geometry.mukca, "the ball stays in each socket, the sockets keep their distance", sockets=True),
    "ours": Entry(ours.ours, "ccnn_torch with its defaults, the written model file", ours.changed),
}


def entry_of(name: str) -> Entry:
    """The entry of a name, or of a file.

    Raises:
        InputError: there is none.
    """
    if name in ENTRIES:
        return ENTRIES[name]
    if ".py:" not in name:
        raise InputError(f"entry {name}: is none of {', '.join(ENTRIES)}; one of your own is path/to/file.py:NAME")
    found = load_plugin(name, (Entry,))
    return found if isinstance(found, Entry) else Entry(found, name.rsplit(":", 1)[1])
