"""Noise that is not independent Gaussian noise of one size, `s x p` each; its RMS is the rig's sigma unless stated."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from ccnn_validation.sources.adversarial.finish import white
from ccnn_validation.sources.adversarial.machine import Array
from ccnn_validation.sources.adversarial.rig import Rig

__all__ = ["autoregressive", "correlated", "heavy_tails", "heteroscedastic", "shared_by_repeats", "walking"]


def heteroscedastic(rig: Rig) -> Array:
    """Three to eight times as large at the far corner of the workspace as at the near one."""
    low, high = rig.pose.min(0), rig.pose.max(0)
    corner = rig.rng.choice([0.0, 1.0], rig.pose.shape[1])
    away = np.linalg.norm((rig.pose - low) / np.maximum(high - low, 1e-12) - corner, axis=1)
    size = 1 + rig.rng.uniform(2.0, 7.0) * (away - away.min()) / np.ptp(away)
    return np.asarray(white(rig) * (size / np.sqrt(np.mean(size**2)))[:, None])


def correlated(rig: Rig) -> Array:
    """All coordinates share nine tenths of their variance, with signs of their own."""
    common = rig.rng.normal(size=(rig.rows, 1)) * rig.rng.choice([-1.0, 1.0], rig.pose.shape[1]) * rig.sigma
    return np.asarray(np.sqrt(0.9) * common + np.sqrt(0.1) * white(rig))


def autoregressive(rig: Rig) -> Array:
    """Each row keeps 0.9 of the error of the row before."""
    fresh: Array = white(rig)
    fresh[1:] *= np.sqrt(1 - 0.9**2)
    return np.asarray(lfilter([1.0], [1.0, -0.9], fresh, axis=0))


def walking(rig: Rig) -> Array:
    """White noise of the rig's sigma, and a measuring device that walks by 0.1 to 0.3 of it from row to row."""
    return white(rig) + np.cumsum(rig.rng.uniform(0.1, 0.3) * white(rig), axis=0)


def shared_by_repeats(rig: Rig) -> Array:
    """Rows of one target (five each) share one error; 0.3 of the noise is each row's own."""
    own = white(rig)
    targets = np.arange(rig.rows) // 5
    return np.asarray(np.sqrt(1 - 0.09) * white(rig)[targets] + 0.3 * own)


def heavy_tails(rig: Rig) -> Array:
    """Student's t with three degrees of freedom, at the same standard deviation."""
    return np.asarray(rig.rng.standard_t(3, size=rig.pose.shape) / np.sqrt(3) * rig.sigma)
