"""`ccnn sweep`: one config with some keys varied, a run for every combination of their values."""
