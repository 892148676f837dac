"""Machines with causes of their own formulas (`case=realistic`): the suite judges effects and learners by their errors,
which were not made by `ccnn_torch.effects`."""
