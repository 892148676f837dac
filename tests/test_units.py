"""Units against scipy's constants, and the errors that pint would let pass."""

from __future__ import annotations

import numpy as np
import pint
import pytest
from hypothesis import given, settings, strategies as st
from scipy import constants

from ccnn_torch.errors import InputError
from ccnn_torch.units import _USUAL, _canonical, _lookup, from_si, parse_header, si_unit_of, to_si

FACTORS = {
    "mm": ("m", 1e-3),
    "um": ("m", 1e-6),
    "µm": ("m", 1e-6),
    "μm": ("m", 1e-6),
    "in": ("m", constants.inch),
    "deg": ("rad", constants.degree),
    "°": ("rad", constants.degree),
    "mrad": ("rad", 1e-3),
    "arcsec": ("rad", constants.arcsec),
    "min": ("s", constants.minute),
    "ms": ("s", 1e-3),
    "kgf": ("N", constants.kgf),
    "lbf": ("N", constants.lbf),
    "Nm": ("N*m", 1.0),
    "N.m": ("N*m", 1.0),
    "N·m": ("N*m", 1.0),
    "N m": ("N*m", 1.0),
    "N*mm": ("N*m", 1e-3),
    "rpm": ("rad/s", 2 * np.pi / 60),
    "deg/s": ("rad/s", constants.degree),
    "mm/s": ("m/s", 1e-3),
    "m/s^2": ("m/s^2", 1.0),
    "s⁻¹": ("1/s", 1.0),
    "N/mm": ("N/m", 1e3),
    "N*m/deg": ("N*m/rad", 1 / constants.degree),
    "g": ("kg", 1e-3),
    "kg*m^2": ("kg*m^2", 1.0),
    "%": ("1", 1e-2),
    # As German, French, Italian and Spanish tables write them.
    "Grad": ("rad", constants.degree),
    "grados": ("rad", constants.degree),
    "º": ("rad", constants.degree),
    "Grad/Sek.": ("rad/s", constants.degree),
    "U/min": ("rad/s", 2 * np.pi / 60),
    "Sek.": ("s", 1.0),
    "Min": ("s", constants.minute),
    "Std": ("s", constants.hour),
    "millimètres": ("m", 1e-3),
    "MM": ("m", 1e-3),
    "Zoll": ("m", constants.inch),
    "Newton": ("N", 1.0),
    "Kelvin": ("K", 1.0),
    "-": ("1", 1.0),
    "1": ("1", 1.0),
}


def test_usual_units_are_those_of_pint_to_the_last_digit() -> None:
    values, registry = np.random.default_rng(0).normal(size=100), pint.UnitRegistry()
    for unit, (si_unit, _) in _USUAL.items():
        expected = registry.Quantity(values, unit).to_base_units().magnitude
        assert np.array_equal(to_si(values, unit), expected), unit
        assert si_unit == _canonical(_lookup(unit).base)


@pytest.mark.parametrize("unit", FACTORS)
def test_scale_and_si_unit(unit: str) -> None:
    si_unit, factor = FACTORS[unit]
    values = np.array([[0.0, 1.0], [-3.25, 1e6]])
    assert si_unit_of(unit) == si_unit
    np.testing.assert_allclose(to_si(values, unit, si_unit), values * factor, rtol=1e-14, atol=0)
    np.testing.assert_allclose(from_si(values * factor, si_unit, unit), values, rtol=1e-14, atol=0)


@pytest.mark.parametrize(
    "unit, scale",
    [(c, "Celsius") for c in ("degC", "°C", "ºC", "C", "Grad Celsius")] + [("degF", "Fahrenheit"), ("K", "Kelvin")],
)
def test_temperature_has_an_offset(unit: str, scale: str) -> None:
    values = np.array([-40.0, 0.0, 21.8675])
    kelvin = constants.convert_temperature(values, scale, "Kelvin")
    np.testing.assert_allclose(to_si(values, unit, "K"), kelvin, rtol=1e-14)
    np.testing.assert_allclose(from_si(kelvin, "K", unit), values, rtol=1e-12, atol=1e-12)


@settings(deadline=None)
@given(st.floats(-1e9, 1e9), st.sampled_from(sorted(FACTORS)))
def test_back_and_forth(value: float, unit: str) -> None:
    there = to_si(value, unit)
    assert from_si(there, si_unit_of(unit), unit) == pytest.approx(value, rel=1e-14, abs=1e-290)


@pytest.mark.parametrize(
    "unit, si_unit",
    [
        ("1", "rad"),
        ("deg", "1"),
        ("rad", "1"),
        ("um/m", "rad"),
        ("mm", "rad"),
        ("deg", "m"),
        ("kg", "N"),
        ("1/s", "rad/s"),
        ("rads", "rad"),
    ],
)
def test_wrong_dimension_names_column_and_remedy(unit: str, si_unit: str) -> None:
    with pytest.raises(InputError) as caught:
        to_si([1.0], unit, si_unit, "records.csv: column 'a'", "a")
    text = str(caught.value)
    assert text.startswith("records.csv: column 'a'") and f"'{unit}'" in text
    remedy = {"rad": "'a[deg]'", "1": "'a[1]'", "m": "'a[mm]'", "K": "'a[degC]'", "N": "'a[N]'", "rad/s": "'a[rad/s]'"}
    assert remedy[si_unit] in text


@pytest.mark.parametrize(
    "unit, remedy",
    [
        ("mmm", "'mm'"),
        ("RAD", "'rad'"),
        ("Deg", "'deg'"),
        ("Mm", "mm"),
        ("grad", "deg"),
        ("dB", "linear"),
        ("dBm", "linear"),
        ("2", "not known"),
        ("m**1e9", "not known"),
        ("m)", "not known"),
        ('"', "not known"),
        ("__import__", "not known"),
        ("10*m", "not known"),
        ("nan", "not known"),
        ("((((", "not known"),
        ("", "not known"),
    ],
)
def test_unknown_unit_is_one_sentence(unit: str, remedy: str) -> None:
    with pytest.raises(InputError, match=r"records\.csv") as caught:
        to_si([1.0], unit, None, "records.csv: column 'a'")
    assert f"'{unit}'" in str(caught.value) and remedy in str(caught.value) and "\n" not in str(caught.value)


@settings(deadline=None)
@given(st.text(max_size=12))
def test_any_text_is_a_unit_or_an_input_error(text: str) -> None:
    try:
        assert np.isfinite(to_si([1.0], text)).all()
    except InputError as error:
        assert "unit" in str(error)


@pytest.mark.parametrize(
    "header, parsed",
    [
        ("q1[rad]", ("q1", "rad")),
        (" load_x [ N ] ", ("load_x", "N")),
        ("t[1]", ("t", "1")),
        ("dew point[degC]", ("dew point", "degC")),
    ],
)
def test_header(header: str, parsed: tuple[str, str]) -> None:
    assert parse_header(header, "r.csv") == parsed


@pytest.mark.parametrize(
    "header, si_unit, parts",
    [
        ("q1", "rad", ("column 'q1' has no unit", "'q1[rad]' or 'q1[deg]'")),
        ("q1", None, ("column 'q1' has no unit", "'q1[rad]'", "'q1[m]'")),
        ("q1[]", "m", ("column 'q1' has no unit", "'q1[m]' or 'q1[mm]'")),
        ("x", None, ("'x[m]' or 'x[mm]'",)),
        ("rz", None, ("'rz[rad]' or 'rz[deg]'",)),
        ("temperature", None, ("'temperature[degC]'",)),
        ("row", None, ("'row[1]'", "no unit")),
        ("q1(rad)", "rad", ("'q1(rad)'",)),
        ("[mm]", None, ("no name",)),
        ("", None, ("no header",)),
        ("q1[rad", None, ("'q1[rad'", "name[unit]")),
        ("q1[rad][mm]", None, ("'q1[rad][mm]'", "name[unit]")),
    ],
)
def test_header_without_unit_says_what_to_write(header: str, si_unit: str | None, parts: tuple[str, ...]) -> None:
    with pytest.raises(InputError) as caught:
        parse_header(header, "records.csv", si_unit)
    assert all(part in str(caught.value) for part in ("records.csv: ", *parts))


def test_si_needs_no_registry_and_gives_a_copy() -> None:
    values = np.array([1.0, 2.0])
    result = to_si(values, "rad", "rad")
    result[0] = 9.0
    assert values[0] == 1.0
