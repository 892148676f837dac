"""The evidence engine: sets of groups of columns, their marginal likelihood, and the verdict on them.

A set is linear in its coefficients, which have normal priors. Nothing here knows what a column stands for: poses
(`diagnosis/`) and logs of motion (`motion/`) fill it with their candidates.
"""
