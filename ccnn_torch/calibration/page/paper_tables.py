"""The tables of paper 000 (Zhang and Gao, IEEE Trans. Ind. Electron. 59(10), 2012), as printed, beside our results.

Misprints, kept here as printed:

* Table I: with the errors of eq. 17 the rows of ρ1 and ρ3 are swapped (the formulas give means of -0.950e-4, 0.919e-4
  and 1.489e-4 m for ρ1, ρ2, ρ3).
* Table II: the last column of ENN does not follow from its joints (their mean mse is 1.778e-10 m²).
* Table III: its spread does not follow from the printed deviations of eq. 19 (2e-5, 5e-4, 2.5e-5 m) but from about
  4e-6, 2.1e-5 and 3.6e-6 m; that is our variant `tabulated`.
* Table IV: the row GRNN repeats for u2 the digits of ρ2 in Table II, and CCNN is below the noise floor of the printed
  deviations.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

Row = tuple[float, ...]


@dataclass(frozen=True)
class PaperCase:
    """What the paper prints of one case study; columns are the joints, and for `after` the last one is all joints.

    Attributes:
        title: name of the case.
        before, after: numbers of the paper's tables.
        symbols: the paper's names of the joints.
        rows: rows for training and verification.
        before_test: (mean, maximum) of the signed error of the verification set [m], one pair a joint.
        methods: method -> (mse [m²], mae [m], sse [m²]), each with one value a joint and one for all joints.
        remark: what a reader must know when comparing.
    """

    title: str
    before: str
    after: str
    symbols: tuple[str, ...]
    rows: tuple[int, int]
    before_test: tuple[Row, ...]
    methods: MappingProxyType[str, tuple[Row, Row, Row]]
    remark: str


_TRIPOD = PaperCase(
    title="case study one, tripod",
    before="I",
    after="II",
    symbols=("ρ1", "ρ2", "ρ3"),
    rows=(100, 25),
    before_test=((1.5050e-4, 1.6847e-4), (9.0889e-5, 1.0883e-4), (-9.2562e-5, -6.7563e-5)),
    methods=MappingProxyType(
        {
            "bp_lm": (
                (7.9493e-10, 9.0117e-10, 2.5542e-9, 1.4168e-9),
                (2.2556e-5, 2.7766e-5, 4.0760e-5, 3.0361e-5),
                (1.9873e-8, 2.2529e-8, 6.3856e-8, 1.0626e-7),
            ),
            "grnn": (
                (2.3939e-10, 3.0567e-10, 1.3712e-9, 6.3875e-10),
                (1.2989e-5, 1.4726e-5, 3.1408e-5, 1.9708e-5),
                (5.9848e-9, 7.6418e-9, 3.4280e-8, 4.7906e-8),
            ),
            "enn": (
                (1.6788e-10, 1.6346e-10, 2.0214e-10, 1.8089e-10),
                (1.0227e-5, 9.9658e-6, 1.1833e-5, 1.0527e-5),
                (4.1972e-9, 4.0865e-9, 5.0535e-9, 1.3567e-8),
            ),
            "ccnn": (
                (9.4504e-11, 1.0614e-10, 1.2658e-10, 1.0907e-10),
                (8.2787e-6, 7.5606e-6, 9.3438e-6, 8.3944e-6),
                (2.3626e-9, 2.6535e-9, 3.1644e-9, 8.1805e-9),
            ),
        }
    ),
    remark=(
        "In the paper's Table I the rows of ρ1 and ρ3 are swapped against its own eq. 17: compare its ρ1 with our q3. "
        "Its BP-LM, GRNN and ENN are worse than a constant correction (about 1.55e-10 m²)."
    ),
)

_MACHINE_TOOL = PaperCase(
    title="case study two, parallel machine tool",
    before="III",
    after="IV",
    symbols=("u1", "u2", "u3"),
    rows=(125, 27),
    before_test=((6.0087e-4, 6.1127e-4), (3.0216e-4, 3.5766e-4), (4.9001e-4, 4.9667e-4)),
    methods=MappingProxyType(
        {
            "bp_lm": (
                (2.2596e-9, 9.4589e-7, 6.0174e-9, 3.1806e-7),
                (3.8286e-5, 8.0882e-4, 6.7983e-5, 3.0503e-4),
                (6.1010e-8, 2.5539e-5, 1.6247e-7, 2.5762e-5),
            ),
            "grnn": (
                (4.6922e-10, 3.0567e-8, 2.1424e-9, 1.1059e-8),
                (1.8185e-5, 1.4726e-4, 3.9260e-5, 6.8234e-5),
                (1.2669e-8, 8.2531e-7, 5.7845e-8, 8.9578e-7),
            ),
            "enn": (
                (1.5321e-10, 1.3586e-8, 9.5220e-10, 4.8970e-9),
                (1.0392e-5, 9.8172e-5, 2.6173e-5, 4.4912e-5),
                (4.1367e-9, 3.6682e-7, 2.5709e-8, 3.9666e-7),
            ),
            "ccnn": (
                (8.6038e-11, 3.6269e-10, 4.5644e-11, 1.6479e-10),
                (8.3452e-6, 1.5635e-5, 5.7632e-6, 9.9144e-6),
                (2.3230e-9, 9.7925e-9, 1.2324e-9, 1.3348e-8),
            ),
        }
    ),
    remark=(
        "The noise that the paper prints in eq. 19 contradicts its Table III, and its Table IV is below the floor of "
        "that noise; only the variant `tabulated` can be compared with its figures. GRNN's u2 repeats digits of "
        "Table II."
    ),
)

PAPER = MappingProxyType(
    {
        "tripod": _TRIPOD,
        "machine_tool:printed": _MACHINE_TOOL,
        "machine_tool:tabulated": _MACHINE_TOOL,
    }
)
"""By the key `case` of `results.json`."""
