"""Programs of robots and machine tools, whose positions are corrected."""

G_CODE = (".nc", ".ngc", ".gcode", ".gco", ".g", ".tap", ".cnc")
PROGRAMS = (*G_CODE, ".src", ".dat", ".mod", ".prg")
"""Endings of G-code, KRL and RAPID."""
