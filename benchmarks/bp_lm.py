"""Levenberg-Marquardt on networks 3-20-3, six starts at once, beside SciPy's and pyrenn's on one after the other.

pyrenn's nodes are hyperbolic tangents, ours and SciPy's sigmoids.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch
from scipy.optimize import least_squares

from benchmarks.measure import Call, Row, compare
from benchmarks.peers import pyrenn_fit
from benchmarks.training import training_rows
from ccnn_torch.evolution import refinement
from ccnn_torch.evolution.gauss_newton import Network, _activations, _backward, _seed, network_of, residual

STARTS, HIDDEN, ITERATIONS = 6, 20, 20
# Iterations that pyrenn makes, and their share of all Jacobians of all starts: it makes one before the first, too.
FEW = 4
SHARE = (FEW + 1) / (ITERATIONS + 1) / STARTS


def run(quick: bool, model: Path | None = None) -> Iterator[Row]:
    """The same number of iterations on the same rows and starts, before the first estimate of precisions."""
    draw = torch.Generator().manual_seed(1)
    shapes = [(HIDDEN, 3), (3, HIDDEN)]
    masks = [torch.ones(STARTS, *shape, dtype=torch.bool) for shape in shapes]
    weights = [torch.randn(STARTS, out, into + 1, generator=draw, dtype=torch.float64) for out, into in shapes]
    # All iterations, on both sides.
    refinement._TOLERANCE = 0.0
    network = network_of([mask[:1] for mask in masks], True)
    first = torch.cat([w[0].flatten() for w in weights]).numpy()
    for rows in (60, 120, 240) if quick else (100, 1000, 10_000):
        data = training_rows(rows)
        x, y = data.inputs, data.targets
        inputs, targets, counts = (values.expand(STARTS, *values.shape[1:]) for values in (x, y, data.weights))

        def scipy_fit(x: torch.Tensor = x, y: torch.Tensor = y) -> object:
            return least_squares(
                lambda w: residual(network, torch.from_numpy(w)[None], x, y, None).flatten().numpy(),
                first,
                lambda w: _jacobian(network, torch.from_numpy(w)[None], x, y).flatten(0, 2).numpy(),
                method="lm",
                max_nfev=ITERATIONS,
            )

        peers: dict[str, tuple[Call, float]] = {"SciPy least_squares (MINPACK)": (scipy_fit, 1 / STARTS)}
        if (fit := pyrenn_fit([3, HIDDEN, 3], x[0], y[0], FEW)) is not None:
            peers["pyrenn train_LM"] = (fit, SHARE)
        yield from compare(
            f"{ITERATIONS} iterations of Levenberg-Marquardt, {STARTS} networks 3-{HIDDEN}-3",
            rows,
            "rows",
            partial(refinement.refine, masks, weights, inputs, targets, counts, ITERATIONS, warm_up=ITERATIONS),
            peers,
            rounds=1 if quick else 3,
        )


def _jacobian(network: Network, flat: torch.Tensor, inputs: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Derivative of `residual` by the weights, laid out in full as MINPACK takes it: `b x s x c x k`."""
    flows = _activations(network, flat, inputs)
    back, inflows = _backward(network, flat, flows, _seed(targets, None), inputs)
    parts = [(b.unsqueeze(-1) * f.unsqueeze(-2).unsqueeze(-2)).flatten(-2) for b, f in zip(back, inflows, strict=True)]
    return torch.cat(parts, dim=-1) * network.active.unsqueeze(1).unsqueeze(1)
