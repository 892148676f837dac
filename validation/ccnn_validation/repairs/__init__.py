"""Public repairs of robot models, replayed: does the diagnosis find what people found?

`python -m ccnn_validation.repairs` takes the numbers of each model before and after a published repair. The model
before it is the nominal one, that after it the true machine, which a tracker measures. The verdict stands beside what
people found, and what it says to enter is entered into the model before the repair, digit by digit.
"""
