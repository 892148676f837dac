"""Independent sources of diagnosis cases with a known answer. They share no formula with the library or each other."""
