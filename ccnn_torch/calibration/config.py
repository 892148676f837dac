"""The config of a run: its keys, defaults and checks.

Relative paths in a config file start from the file's folder, those on the command line from the current one.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field, field_validator, model_validator

from ccnn_torch.config.sizes import Size
from ccnn_torch.config.split import SplitConfig
from ccnn_torch.config.tree import (
    Columns,
    Files,
    JobConfig,
    JointMap,
    MechanismKeys,
    Names,
    Section,
)
from ccnn_torch.effects import EFFECTS
from ccnn_torch.evolution.settings import CCNNSettings, ENNSettings
from ccnn_torch.learners.bp_lm import BPLMSettings
from ccnn_torch.learners.gp import GPSettings
from ccnn_torch.learners.grnn import GRNNSettings
from ccnn_torch.learners.registry import LEARNERS
from ccnn_torch.spelling import hint


def _one(value: Any) -> Any:
    return [value] if isinstance(value, int | float) else value


Numbers = Annotated[
    list[Annotated[float, Field(gt=0)]], BeforeValidator(_one, json_schema_input_type=float | list[float])
]


class _Part(Section):
    model_config = ConfigDict(coerce_numbers_to_str=True)


class TrainingConfig(_Part):
    """How the trainer uses the validation rows and how often it saves."""

    early_stop: bool = Field(
        default=True,
        description="find the best step on the validation rows, then refit on all training rows for so long",
    )
    folds: int = Field(
        default=1,
        ge=1,
        description="1 = hold the rows of split.validation out; K > 1 = cross-validate in K folds of the training rows",
    )
    patience: int | None = Field(
        default=None, ge=1, description="steps without improvement after which that search ends; null = go to the end"
    )
    checkpoint_every: int = Field(default=20, ge=1, description="steps between two checkpoints")
    log_every: int = Field(default=1, ge=1, description="steps between two points of the held-out curves")


class CompensationConfig(_Part):
    """Guard and limit of the compensator."""

    margin: float = Field(
        default=0.1,
        ge=0,
        description="how far beyond the training inputs the correction is trusted, as a share of their half range",
    )
    limit: Numbers | None = Field(
        default=None,
        min_length=1,
        description="hard limit of the correction in SI, one number or one per joint; null = 1.5 times the largest "
        "training deviation of each joint",
    )
    ends: dict[str, Annotated[list[Size], Field(min_length=2, max_length=2)]] = Field(
        default={},
        description="lowest and highest value of a covariate up to which its effects act where it goes beyond what was "
        "measured, e.g. {load_z: [-150 N, 0 N]}; what was measured where nothing is said, of a temperature half of its "
        "range more on both sides",
    )


class RealisticConfig(_Part):
    """A simulated real machine (case=realistic); every repeat has a machine, poses and noise of its own."""

    machine: Literal["tripod", "machine_tool", "arm"] = Field(
        default="tripod", description="tripod, machine_tool or arm (six joints)"
    )
    cause: Literal["geometry", "compliance", "transmission", "thermal", "backlash", "mixed"] = Field(
        default="mixed",
        description="what makes it miss: geometry, compliance, transmission, thermal, backlash, or mixed = all of them",
    )
    strength: float = Field(default=1.0, ge=0, description="size of the cause; 1 = 0.05 to 0.3 mm of pose error")
    rows: int = Field(default=200, ge=20, description="poses measured")
    noise: float = Field(
        default=5e-6,
        gt=0,
        description="standard deviation of each measured coordinate of the position in m; an angle has it over 0.3 m",
    )


class AutoConfig(_Part):
    """How `methods=auto` chooses a method."""

    methods: Names = Field(
        default=["constant", "grnn", "gp", "bp_lm", "enn", "ccnn"],
        min_length=1,
        description="the methods that methods=auto compares, in the order in which they are tried: cheap ones first",
    )
    budget: float = Field(
        default=300.0,
        gt=0,
        description="seconds inside the learners that the comparison may take; the refit comes on top",
    )
    folds: int = Field(default=5, ge=2, description="folds of the training rows that the methods are compared by")

    @field_validator("methods")
    @classmethod
    def _known(cls, methods: list[str]) -> list[str]:
        return _checked(methods, tuple(LEARNERS))


def _checked(methods: list[str], choices: tuple[str, ...]) -> list[str]:
    for method in methods:
        if method not in choices and ".py:" not in method:
            near = hint(method, choices, "known are", " and file.py:Name")
            raise ValueError(f"there is no method '{method}'; {near}")
        if methods.count(method) > 1:
            raise ValueError(f"'{method}' is given twice")
    return methods


class RunConfig(JobConfig):
    """A run: data, split, methods and their settings."""

    model_config = _Part.model_config

    name: str = Field(default="run", min_length=1, description="name of the run; default: the config file's name")
    seed: int = Field(default=0, ge=0, lt=2**63, description="seed of the first repeat; repeat k has seed + k")
    repeats: int = Field(
        default=1, ge=1, description="independent repeats, side by side: new noise, split and start each"
    )
    out: str | None = Field(default=None, description="folder to write; default runs/NAME-STAMP")
    methods: Names | None = Field(
        default=None,
        min_length=1,
        description=f"learners: a list of {', '.join(LEARNERS)}; all = these; auto = the best of auto.methods "
        "by cross-validation; null = ccnn, and where geometry=auto compared a learner, what that comparison prefers",
    )
    max_bytes: int | None = Field(
        default=None,
        ge=1,
        description="memory in bytes that a run may take; what takes more is refused, and no step of a training takes "
        "more; null = what is free, and 128 MiB for a step",
    )
    device: str = Field(default="cpu", pattern=r"^(cpu|cuda(:\d+)?|mps)$", description="cpu, cuda, cuda:N or mps")
    covariates: Names | None = Field(
        default=None,
        description="inputs beside the joints, names or patterns; null = time, temperature, load_*, torque_*, "
        "direction*, speed* where they are there; [] = none",
    )
    split: SplitConfig = Field(default_factory=SplitConfig)
    case: Literal["tripod", "machine_tool", "realistic"] | None = Field(
        default=None,
        description="simulated data: a case study of the paper, tripod or machine_tool; a realistic machine; or null "
        "and records instead",
    )
    realistic: RealisticConfig = Field(default_factory=RealisticConfig)
    variant: Literal["printed", "tabulated"] | None = Field(
        default=None,
        description="noise of the machine_tool case: printed (eq. 19) or tabulated (Table III); default printed",
    )
    order: Literal["raster", "shuffled"] | None = Field(
        default=None, description="order in which a case visits its poses: raster or shuffled; default raster"
    )
    records: Files | None = Field(
        default=None,
        description="measured records, a CSV file (or .xlsx) with headers name[unit], or a list of such files",
    )
    columns: Columns
    joint_map: JointMap
    mechanism: str | None = Field(
        default=None,
        description="mechanism of the records: tripod, machine_tool, a DH file (.yaml), a URDF, or file.py:Name",
    )
    mechanism_keys: MechanismKeys
    geometry: Literal["auto", "identify", "none"] = Field(
        default="auto",
        description="identify = find all geometric parameters on the training rows of records, and let the network "
        "learn only what they leave; the model files hold both. none = the network learns everything. auto = what "
        "cross-validation prefers of identified geometry alone, or either with a learner; none for cases and effects",
    )
    effects: str | list[str] = Field(
        default="auto",
        description="physical causes that are a part of the model, so that the network learns only what they leave: "
        "auto = those without which the training rows would be less probable, where cross-validation finds that they "
        "pay (none for cases); a list = the same among these; from:DIR/diagnosis.json = what a diagnosis named; none",
    )
    rotation_weight: float = Field(
        default=0.04, gt=0, description="weight of orientation against position in m per rad (η of eq. 5)"
    )
    damping: float | None = Field(
        default=None,
        ge=0,
        description="weight of the joint deviation itself beside the pose error it explains, in m per rad; keeps it "
        "small near singular poses; null = 0.01 for a serial arm, 0 for other mechanisms",
    )
    max_condition: float | None = Field(
        default=None,
        gt=1,
        description="rows whose Jacobian is worse conditioned are not trained on, but still judged; null = 50, and no "
        "bound where damping is above 0",
    )
    max_deviation: float | None = Field(
        default=None, gt=0, description="rows with a larger joint deviation (SI) are not trained on; null = no bound"
    )
    training: TrainingConfig = Field(default_factory=TrainingConfig)
    auto: AutoConfig = Field(default_factory=AutoConfig)
    compensation: CompensationConfig = Field(default_factory=CompensationConfig)
    refit: bool = Field(
        default=True,
        description="fit the model that is saved again to all rows of measured records, and search its effects there, "
        "when it was chosen and judged without those held out; not with repeats, nor where split.test names a file",
    )
    save_models: bool = Field(default=True, description="write model files and their card")
    save_report: bool = Field(
        default=True, description="draw plots/ and write report.html; results.json, .csv and .md are always written"
    )
    ccnn: CCNNSettings = Field(default_factory=CCNNSettings)
    bp_lm: BPLMSettings = Field(default_factory=BPLMSettings)
    grnn: GRNNSettings = Field(default_factory=GRNNSettings)
    enn: ENNSettings = Field(default_factory=ENNSettings)
    gp: GPSettings = Field(default_factory=GPSettings)

    @model_validator(mode="before")
    @classmethod
    def _of_the_case(cls, tree: Any) -> Any:
        """A case has its order and the machine tool its variant."""
        if not isinstance(tree, dict) or tree.get("case") not in ("tripod", "machine_tool"):
            return tree
        usual = {"order": "raster"} | ({"variant": "printed"} if tree["case"] == "machine_tool" else {})
        return tree | {key: value for key, value in usual.items() if tree.get(key) is None}

    @field_validator("methods")
    @classmethod
    def _known(cls, methods: list[str] | None) -> list[str] | None:
        for method in _checked(methods or [], (*LEARNERS, "all", "auto")):
            if method in ("all", "auto") and len(methods or []) > 1:
                raise ValueError(f"'{method}' cannot be combined with other names; remove them or '{method}'")
        return methods

    @field_validator("effects")
    @classmethod
    def _known_effects(cls, effects: str | list[str]) -> str | list[str]:
        if isinstance(effects, str):
            if effects not in ("auto", "none") and not effects.startswith("from:"):
                raise ValueError(
                    f"is '{effects}'; write effects=from:{effects} for such a file, [NAME, …] for effects of the "
                    "library, auto or none"
                )
            return effects
        for name in effects:
            if name not in EFFECTS:
                near = hint(name, tuple(EFFECTS), "known are")
                raise ValueError(f"there is no effect '{name}' that a model file can hold; {near}")
        return effects or "none"

    @model_validator(mode="after")
    def _one_source(self) -> RunConfig:
        if (self.case is None) == (self.records is None):
            both = "both case and records are given; remove one" if self.case else "no data is named"
            raise ValueError(
                f"{both}: case=tripod, case=machine_tool, case=realistic, or records=FILE.csv with mechanism=…"
            )
        if self.records is not None and self.mechanism is None:
            raise ValueError(
                "mechanism: records need it; write mechanism=tripod, machine_tool, a DH file, a URDF or file.py:Name"
            )
        if self.case is not None and self.mechanism not in (None, self.case):
            raise ValueError(f"mechanism: the case {self.case} brings its own; remove the key")
        if self.variant is not None and self.case != "machine_tool":
            raise ValueError("variant: only the case machine_tool has variants; remove the key")
        if self.realistic != RealisticConfig() and self.case != "realistic":
            raise ValueError("realistic: these keys need case=realistic; write that, or remove them")
        if self.order is not None and self.case == "realistic":
            raise ValueError("order: a realistic machine visits random poses; remove the key")
        if self.order is not None and self.case is None:
            raise ValueError("order: records have the order in which they were measured; remove the key")
        if self.case is not None and self.split.test_file is not None:
            raise ValueError("split.test: a case makes its own rows and takes no file; write a share, e.g. 0.3")
        if self.case is not None and (self.columns or self.joint_map):
            raise ValueError("columns, joint_map: a case reads no file; remove the key")
        if self.case is not None and self.geometry == "identify":
            raise ValueError("geometry: a case is there to compare learners; write geometry=none, or take records")
        if self.case is not None and self.effects not in ("auto", "none"):
            raise ValueError("effects: a case is there to compare learners; write effects=none, or take records")
        folds = self.training.folds > 1 or self.methods == ["auto"]
        if self.training.early_stop and self.split.validation == 0 and not folds:
            raise ValueError(
                "training.early_stop: it needs validation rows; write split.validation=0.2, training.folds=5 or "
                "training.early_stop=false"
            )
        return self

    def settings(self, method: str) -> object:
        """The section of a method's name; None where it has none."""
        return getattr(self, method, None) if method in LEARNERS else None


def method_names(config: RunConfig, default: str = "ccnn") -> list[str]:
    """The methods to train: ``all`` and ``auto`` spelt out; `default` where the config names none and sets no ccnn."""
    if config.methods is None:
        return [default if config.ccnn == CCNNSettings() else "ccnn"]
    if config.methods == ["all"]:
        return list(LEARNERS)
    if config.methods == ["auto"]:
        return list(config.auto.methods)
    return list(config.methods)
