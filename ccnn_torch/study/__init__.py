"""Many runs of one config, side by side: `ccnn suite`, `ccnn sweep` and `ccnn compare`."""
