"""Which effect causes the gap between model and machine, where it lies, and how far it shrinks."""
