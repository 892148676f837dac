"""The blind check: machines whose cause is sealed from the diagnosis, and the judge that opens them afterwards."""
