"""Judges of the library: machines and causes with formulas of their own, and the checks that use them."""
