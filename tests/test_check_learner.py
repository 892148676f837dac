"""The conformance check passes what keeps the contract and names what does not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from toy import Descent

from ccnn_torch.evolution.settings import CCNNSettings, ENNSettings
from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.learners.bp_lm import BPLM, BPLMSettings
from ccnn_torch.learners.ccnn import CCNN
from ccnn_torch.learners.constant import Constant
from ccnn_torch.learners.enn import ENN
from ccnn_torch.learners.grnn import GRNN, GRNNSettings
from ccnn_torch.learners.registry import make_learner
from ccnn_torch.testing import check_learner

EXAMPLE = f"{Path(__file__).parent.parent / 'experiments' / 'my_learner.py'}:Ridge"
SMALL = {
    "hidden": (3, 2),
    "population": 8,
    "generations": 6,
    "members": 1,
    "refinement_iterations": 0,
}


FACTORIES: dict[str, Callable[[], Learner]] = {
    "ccnn": lambda: CCNN(CCNNSettings(**SMALL)),
    "ccnn_without_bias": lambda: CCNN(CCNNSettings(**SMALL, bias=False)),
    "ccnn_refined": lambda: CCNN(
        CCNNSettings(
            **{
                **SMALL,
                "generations": 4,
                "refinement_iterations": 2,
                "members": 2,
                "rival_hidden": (2,),
                "waves": 4,
                "wave_searches": 1,
            }
        )
    ),
    "bp_lm": lambda: BPLM(BPLMSettings(hidden=(3,), restarts=2, iterations=5)),
    "bp_lm_at_rest": lambda: BPLM(BPLMSettings(hidden=(2, 3), restarts=1, iterations=8, tolerance=0.1, patience=1)),
    "grnn": lambda: GRNN(GRNNSettings(iterations=5, candidates=6)),
    "grnn_some_rows": lambda: GRNN(GRNNSettings(iterations=4, candidates=6, queries=10, references=40)),
    "enn": lambda: ENN(ENNSettings(hidden=(3, 2), population=10, generations=6)),
    "enn_without_bias": lambda: ENN(ENNSettings(hidden=(4,), population=9, generations=5, bias=False)),
    "constant": Constant,
    "descent": lambda: Descent(steps=8),
    "a user's": lambda: make_learner(EXAMPLE),
}


@pytest.mark.parametrize("factory", FACTORIES.values(), ids=FACTORIES)
def test_learners_keep_the_contract(factory: Callable[[], Learner]) -> None:
    check_learner(factory)


class GlobalRandom(Descent):
    def start(self, data: TrainingData) -> None:
        super().start(data)
        self._map = self._map + 0.01 * torch.randn(self._map.shape, dtype=torch.float64)


class Forgetful(Descent):
    """Its state lacks the velocity."""

    def state_dict(self) -> dict[str, Tensor]:
        return {name: value for name, value in super().state_dict().items() if name != "velocity"}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        super().load_state_dict(state | {"velocity": torch.zeros_like(state["map"])})


class Unweighted(Descent):
    """Looks at the padded rows."""

    def start(self, data: TrainingData) -> None:
        ones = torch.ones_like(data.weights)
        super().start(TrainingData(data.inputs, data.targets, ones, data.seeds))


class Endless(Descent):
    @property
    def finished(self) -> bool:
        return False


class Single(Descent):
    def network(self, repeat: int) -> nn.Module:
        return super().network(repeat).to(torch.float32)


class Other(Descent):
    def network(self, repeat: int) -> nn.Module:
        return super().network(0)


class ScalarMetric(Descent):
    def step(self) -> dict[str, Tensor]:
        return {name: value.mean() for name, value in super().step().items()}


class WrongShape(Descent):
    def predict(self, inputs: Tensor) -> Tensor:
        return super().predict(inputs)[..., :1]


class Spoiler(Descent):
    def step(self) -> dict[str, Tensor]:
        self._data.targets.mul_(0.9)
        return super().step()


class Silent(Descent):
    def step(self) -> dict[str, Tensor]:
        return {"error_train": super().step()["error_train"]}


class Optimist(Descent):
    def step(self) -> dict[str, Tensor]:
        metrics = super().step()
        return metrics | {"error_train": metrics["error_train"] / 2}


class Certain(Descent):
    """Sure of itself, and the more so the further it is from the rows."""

    def variance(self, inputs: Tensor) -> Tensor:
        return torch.exp(-self.predict(inputs).square())


class Unsure(Descent):
    """Its networks do not know the variance."""

    def variance(self, inputs: Tensor) -> Tensor:
        return 1 + self.predict(inputs).square()


class Vague(Descent):
    @property
    def converged(self) -> bool:
        return True


class NotALearner:
    name = "none"


@pytest.mark.parametrize(
    ("broken", "sentence"),
    [
        (GlobalRandom, "global random state"),
        (Forgetful, "stopped after step 1 and resumed ends elsewhere"),
        (Unweighted, "rows of weight 0"),
        (Endless, "not finished after the 8 steps"),
        (Single, "holds torch.float32; must be float64"),
        (Other, "network.1. differs from predict"),
        (ScalarMetric, "metric 'error_train' has shape"),
        (WrongShape, "predict before the first step gives shape"),
        (Spoiler, "changes the data"),
        (Silent, "no metric 'evaluations'"),
        (Optimist, "'error_train' of the last step is not"),
        (Certain, "variance must be finite and above 0"),
        (Unsure, "lacks variance, which the learner has"),
        (Vague, "converged must be one bool a repeat"),
    ],
)
def test_a_broken_promise_is_named(broken: Callable[..., Learner], sentence: str) -> None:
    with pytest.raises(AssertionError, match=sentence):
        check_learner(lambda: broken(steps=8))


def test_a_class_that_lacks_a_verb_is_named() -> None:
    with pytest.raises(AssertionError, match="NotALearner lacks start, step"):
        check_learner(NotALearner)  # type: ignore[arg-type]
