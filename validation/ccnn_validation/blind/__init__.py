"""The blind check: simulated machines whose cause the diagnosis does not know, and the comparison with the truth."""
