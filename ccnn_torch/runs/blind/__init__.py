"""Machines whose cause is sealed from the diagnoser, and the check of the diagnosis on them."""
