"""What every machine has that holds another one inside: rows' conditions are the inner machine's."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Self

from torch import Tensor

from ccnn_torch.coordinates import Condition
from ccnn_torch.mechanisms.mechanism import Mechanism


class Around(Mechanism):
    """A mechanism that is another one, `mechanism`, seen or placed in some way."""

    mechanism: Mechanism

    def under(self, conditions: Mapping[str, Tensor]) -> Self:
        """The mechanism inside under them."""
        inner = self.mechanism.under(conditions)
        if inner is self.mechanism:
            return self
        twin = copy.copy(self)
        twin._modules = {**self._modules, "mechanism": inner}
        return twin

    def lacking(self, conditions: Sequence[str]) -> list[Condition]:
        """As of the mechanism inside."""
        return self.mechanism.lacking(conditions)
