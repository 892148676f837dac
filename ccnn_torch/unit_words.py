"""Units as German, French, Italian and Spanish tables write them, for the ones that pint knows."""

from __future__ import annotations

import re
from functools import cache

# Not grad, which is a degree to some and a 400th of a turn to others. pint would read Grad as gigaradians, MM as
# megamolar, Min as megainches, Nm as textile number metres, and C as coulombs.
_WORDS = {
    "deg": "Grad Altgrad Winkelgrad gradi grado grados degré degrés º",
    "rad": "Radiant radianti radianes radián radiani",
    "arcmin": "Bogenminuten Winkelminuten",
    "arcsec": "Bogensekunden Winkelsekunden",
    "s": "Sek sek Sekunde Sekunden seconde secondes secondi segundos Sec",
    "min": "Min Minute Minuten minuti minutos",
    "h": "Std std Stunde Stunden heure heures ore hora horas",
    "m": "Meter mètre mètres metri metros",
    "mm": "MM Millimeter millimètre millimètres millimetri milímetros milimetros",
    "um": "Mikrometer micromètre micromètres micrometri micrómetros",
    "in": "Zoll pouce pouces pollici pulgadas",
    "K": "Kelvin",
    "degC": "Celsius ºC",
    "N": "Newton",
    "N*m": "Nm",
    "N*mm": "Nmm",
    "rpm": "RPM",
}
_WHOLE = {
    **dict.fromkeys(("C", "℃", "Grad C", "Grad Celsius", "deg C", "° C", "º C"), "degC"),
    **dict.fromkeys(("U/min", "tr/min", "giri/min"), "rpm"),
    **dict.fromkeys(("-", "–", "—"), "1"),
}
_BY_WORD = {word: unit for unit, words in _WORDS.items() for word in words.split()}
_LETTERS = re.compile(r"[^\W\d_]+")


@cache
def as_read(unit: str) -> str:
    """The unit in the words that are looked up, e.g. ``deg/s`` for ``Grad/Sek.``; any other text as it is."""
    unit = unit.removesuffix(".") if _LETTERS.fullmatch(unit.removesuffix(".")[-1:]) else unit
    return _WHOLE.get(unit) or _LETTERS.sub(lambda word: _BY_WORD.get(word[0], word[0]), unit)
