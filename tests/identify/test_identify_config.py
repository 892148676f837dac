"""Keys of an identification: what is right, and one sentence for what is not."""

from pathlib import Path

import pytest
import torch

from ccnn_torch.config.keys import list_keys
from ccnn_torch.config.sizes import prior_sizes, size, sizes_by_name, sizes_of_pose
from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.identify import identify
from ccnn_torch.mechanisms import load_mechanism

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


@pytest.mark.parametrize("name", ["five_bar", "overconstrained_2dof"])
def test_an_experiment_is_the_same_when_written_and_read_back(name: str, tmp_path: Path) -> None:
    config = IdentifyConfig.from_file(EXPERIMENTS / f"{name}.yaml")
    path = tmp_path / "config.yaml"
    path.write_text(config.to_yaml())
    assert IdentifyConfig.from_file(path) == config


def test_the_overconstrained_experiment_runs_every_method() -> None:
    config = IdentifyConfig.from_file(EXPERIMENTS / "overconstrained_2dof.yaml", ["methods=all"])
    assert config.methods == ["lm", "hga", "tikhonov"]
    assert config.simulate is not None
    assert (config.simulate.machines, config.hga_machines) == (100, 5)


def test_every_key_is_described() -> None:
    keys = {key: text for key, _, text in list_keys(IdentifyConfig)}
    assert all(keys.values())
    assert {"mechanism", "simulate.machines", "parameters.free", "split.test", "hga_machines"} <= set(keys)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "no data is named"),
        ({"simulate": {}, "records": "a.csv"}, "both records and simulate are given"),
        ({"simulate": {}, "methods": ["lm_per_legs"]}, "no method 'lm_per_legs'; did you mean 'lm_per_leg'"),
        ({"simulate": {}, "methods": ["sa_per_leg"]}, "'sa_per_leg' is no method any more; `python -m benchmarks.glob"),
        ({"simulate": {}, "methods": ["lm", "lm"]}, "'lm' is given twice"),
        ({"simulate": {"machine": 3}}, "no key 'simulate.machine'; did you mean 'simulate.machines'"),
        ({"simulate": {}, "noise": 1e-5}, "simulated data has simulate.noise"),
        ({"simulate": {"as_built": True}}, "give simulate.points"),
        ({"simulate": {}, "settings": {"lmm": {}}}, "settings: there is no method 'lmm'; did you mean 'lm'"),
    ],
)
def test_wrong_keys_are_one_sentence(keys: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        IdentifyConfig.from_keys(mechanism="five_bar", **keys)
    assert "\n" not in str(caught.value)


def test_a_mechanism_must_be_named() -> None:
    with pytest.raises(InputError, match="mechanism: name one"):
        IdentifyConfig.from_keys(simulate={})


def test_sizes_have_units() -> None:
    assert size("0.4 mm", "m", "key") == pytest.approx(4e-4)
    assert size("0.5", "m", "key") == 0.5
    assert size("180 deg", "rad", "key") == pytest.approx(torch.pi)
    with pytest.raises(InputError, match="key: 'much' is no number"):
        size("much", "m", "key")
    with pytest.raises(InputError, match=r"key.*deg"):
        size("1 deg", "m", "key")


def test_sizes_go_by_name_pattern_or_unit() -> None:
    geometry = load_mechanism("five_bar").geometry
    given = {"m": "1 mm", "A*x": "2 mm", "gamma2": "0.1 deg"}
    found = dict(zip([p.name for p in geometry], sizes_by_name(given, geometry, "k", [0.0] * 12).tolist(), strict=True))
    assert found["l1"] == 1e-3
    assert found["A1x"] == found["A2x"] == 2e-3
    assert found["gamma1"] == found["k1"] == 0
    assert found["gamma2"] == pytest.approx(0.1 * torch.pi / 180)
    with pytest.raises(InputError, match=r"k\.gama1: there is no such name; did you mean 'gamma1'"):
        sizes_by_name({"gama1": 1.0}, geometry, "k", [0.0] * 12)


def test_an_angle_has_the_noise_over_its_arm() -> None:
    pose = load_mechanism("tripod").pose
    assert sizes_of_pose(3e-5, pose, "noise").tolist() == pytest.approx([3e-5, 3e-5, 1e-4])
    with pytest.raises(InputError, match="noise: gives no size of phi"):
        sizes_of_pose({"y": 1e-5, "z": 1e-5}, pose, "noise")


def test_a_prior_has_the_unit_of_its_parameter_and_its_errors_speak_of_no_column() -> None:
    geometry = load_mechanism("five_bar").geometry
    assert prior_sizes({"l1": "0.5 mm", "gamma*": "1 mrad", "k1": 0.1}, geometry, "parameters.prior") == pytest.approx(
        {"l1": 5e-4, "gamma*": 1e-3, "k1": 0.1}
    )
    wrong = {"l1": "0.5 deg", "gamma1": "1 mm", "leg1.*": "1 mm", "k1": "1 s"}
    for pattern, value in wrong.items():
        with pytest.raises(
            InputError, match=r"parameters\.prior\..* is in '.*, but must be .*or a number in SI$"
        ) as said:
            prior_sizes({pattern: value}, geometry, "parameters.prior")
        assert "[" not in str(said.value)
    with pytest.raises(InputError, match=r"parameters\.prior: 'b\*' fits no parameter"):
        prior_sizes({"b*": 1.0}, geometry, "parameters.prior")


def test_identify_refuses_a_prior_of_the_wrong_kind() -> None:
    config = IdentifyConfig.from_keys(
        mechanism="five_bar", simulate={"poses": 20}, parameters={"prior": {"l1": "0.5 deg"}}, save_report=False
    )
    with pytest.raises(InputError, match=r"parameters\.prior\.l1 is in 'deg', an angle, but must be a length"):
        identify(config)
